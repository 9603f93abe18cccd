#include "fastloop/matching/descriptor_matching.hpp"

#include <gtest/gtest.h>

#include <map>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/descriptor_pairs_for_tests.hpp"
#include "fastloop/matching/rotation_histogram.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::add_keypoint;
using testing::finish;
using testing::random_pair;
using testing::Side;

std::vector<std::int32_t> brute_force(const Side& a, const Side& b, bool grouped,
                                      const DescriptorMatchOptions& options) {
  std::vector<std::int32_t> result(a.features.size(), kNoMatch);
  std::map<int, std::pair<int, int>> owner;
  for (int i = 0; i < static_cast<int>(a.features.size()); ++i) {
    if (!a.blocked.empty() && a.blocked[i]) continue;
    std::vector<std::pair<int, int>> found;
    for (int k = 0; k < static_cast<int>(b.features.size()); ++k) {
      if (!b.blocked.empty() && b.blocked[k]) continue;
      if (grouped && (a.node[i] == 0 || a.node[i] != b.node[k])) continue;
      found.emplace_back(hamming_distance(a.features.descriptors[i], b.features.descriptors[k]), k);
    }
    std::sort(found.begin(), found.end());
    if (found.empty() || found[0].first > options.max_distance) continue;
    if (options.best_to_second < 1 && found.size() > 1 &&
        static_cast<float>(found[0].first) >=
            options.best_to_second * static_cast<float>(found[1].first))
      continue;
    const auto [it, fresh] = owner.try_emplace(found[0].second, found[0].first, i);
    if (!fresh) it->second = std::min(it->second, {found[0].first, i});
  }
  for (const auto& [k, claim] : owner) result[claim.second] = k;
  return result;
}

TEST(DescriptorMatching, EqualsBruteForceWithBothExecutors) {
  int grouped_matches = 0, matches = 0;
  for (unsigned seed = 0; seed < 200; ++seed) {
    const auto [a, b] = random_pair(seed);
    DescriptorMatchOptions options;
    options.best_to_second = seed % 4 == 0 ? 1 : 0.9f;
    options.check_rotation = false;
    for (const bool grouped : {false, true}) {
      const auto expected = brute_force(a, b, grouped, options);
      for (const Executor& executor : {Executor::reference(), Executor::cpu()})
        ASSERT_EQ(match_descriptors(executor, a.view(grouped), b.view(grouped), options), expected)
            << seed;
      for (const int k : expected) (grouped ? grouped_matches : matches) += k != kNoMatch;
    }
  }
  EXPECT_GT(grouped_matches, 500);
  EXPECT_GT(matches, 500);
}

TEST(DescriptorMatching, IsOneToOneAndDropsOddRotations) {
  for (unsigned seed = 1; seed < 20; ++seed) {
    const auto [a, b] = random_pair(seed);
    DescriptorMatchOptions options;
    options.check_rotation = false;
    const auto all = match_descriptors(Executor::cpu(), a.view(true), b.view(true), options);
    options.check_rotation = true;
    const auto kept = match_descriptors(Executor::cpu(), a.view(true), b.view(true), options);
    std::map<int, int> used;
    auto expected = all;
    drop_odd_rotations(a.features.angle_rad, b.features.angle_rad, expected);
    EXPECT_EQ(kept, expected);
    for (const int k : all)
      if (k != kNoMatch) ++used[k];
    for (const auto& [k, times] : used) EXPECT_EQ(times, 1);
  }
}

/// One keypoint against two, at chosen distances.
TEST(DescriptorMatching, Thresholds) {
  std::mt19937 rng(4);
  const Descriptor d = testing::random_descriptor(rng);
  const auto flipped = [&](int bits) {
    Descriptor r = d;
    for (int b = 0; b < bits; ++b) r.words[b / 64] ^= std::uint64_t{1} << (b % 64);
    return r;
  };
  const auto match = [&](std::vector<int> distances, float ratio) {
    FeatureSet a, b;
    add_keypoint(a, 10, 10, 0, d);
    for (const int bits : distances) add_keypoint(b, 10, 10, 0, flipped(bits));
    finish(a, testing::pinhole_rig().left);
    finish(b, testing::pinhole_rig().left);
    DescriptorMatchOptions options;
    options.best_to_second = ratio;
    return match_descriptors(Executor::cpu(), {&a, nullptr, {}}, {&b, nullptr, {}}, options)[0];
  };
  EXPECT_EQ(match({50}, 1), 0);
  EXPECT_EQ(match({51}, 1), kNoMatch);
  EXPECT_EQ(match({50, 35}, 0.75f), 1);
  EXPECT_EQ(match({40, 30}, 0.75f), kNoMatch);
  EXPECT_EQ(match({41, 30}, 0.75f), 1);
  EXPECT_EQ(match({30, 30}, 1), 0);
  EXPECT_EQ(match({}, 1), kNoMatch);
}

TEST(DescriptorMatching, RejectsBrokenInput) {
  auto [a, b] = random_pair(1);
  const auto match = [&] { return match_descriptors(Executor::cpu(), a.view(true), b.view(true)); };
  EXPECT_NO_THROW(match());
  EXPECT_THROW(match_descriptors(Executor::cpu(), {}, b.view(true)), InvalidArgument);
  a.blocked.resize(1);
  EXPECT_THROW(match(), InvalidArgument);
  a.blocked.clear();
  b.groups.indices.back() = static_cast<std::uint16_t>(b.features.size());
  EXPECT_THROW(match(), InvalidArgument);
  b.groups.indices.back() = 0;
  b.groups.start.pop_back();
  EXPECT_THROW(match(), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::matching
