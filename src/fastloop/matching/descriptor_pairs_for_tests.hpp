#pragma once

#include <map>
#include <utility>

#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching::testing {

struct Side {
  FeatureSet features;
  std::vector<std::uint32_t> node;  ///< [keypoints] 0 = in no group
  FeatureGroups groups;
  std::vector<std::uint8_t> blocked;

  void group() {
    std::map<std::uint32_t, std::vector<std::uint16_t>> by_node;
    for (std::size_t i = 0; i < node.size(); ++i)
      if (node[i]) by_node[node[i]].push_back(static_cast<std::uint16_t>(i));
    groups = {};
    groups.start.push_back(0);
    for (const auto& [id, members] : by_node) {
      groups.node.push_back(id);
      groups.indices.insert(groups.indices.end(), members.begin(), members.end());
      groups.start.push_back(static_cast<std::uint32_t>(groups.indices.size()));
    }
  }
  MatchSide view(bool with_groups) const {
    return {&features, with_groups ? &groups : nullptr, blocked};
  }
};

/// Two images of about 50 appearances; keypoints of one appearance are mostly in one group.
inline std::pair<Side, Side> random_pair(unsigned seed) {
  std::mt19937 rng(seed);
  std::vector<Descriptor> looks;
  for (int i = 0; i < 50; ++i) looks.push_back(random_descriptor(rng));
  std::pair<Side, Side> pair;
  for (Side* s : {&pair.first, &pair.second}) {
    const int n = seed % 10 == 0 ? static_cast<int>(rng() % 3) : static_cast<int>(rng() % 300);
    for (int i = 0; i < n; ++i) {
      const unsigned look = rng() % 50;
      add_keypoint(s->features, rng() % 700, rng() % 400, static_cast<int>(rng() % 8),
                   with_flipped_bits(looks[look], static_cast<int>(rng() % 25), rng),
                   static_cast<float>(0.02 * look));
      s->node.push_back(rng() % 8 == 0 ? rng() % 5 : look / 10);
      if (seed % 3 == 0) s->blocked.push_back(rng() % 4 == 0);
    }
    finish(s->features, pinhole_rig().left);
    s->group();
  }
  return pair;
}

}  // namespace fastloop::matching::testing
