#include "fastloop/matching/claims.hpp"

#include <vector>

namespace fastloop::matching {

int resolve_claims(std::span<const MatchKey> keys, std::size_t num_keypoints,
                   std::span<std::int32_t> keypoint, std::span<std::uint16_t> distance) {
  std::vector<std::int32_t> owner(num_keypoints, -1);
  int count = 0;
  for (std::size_t i = 0; i < keys.size(); ++i) {
    keypoint[i] = kNoMatch;
    if (!distance.empty()) distance[i] = 0;
    if (keys[i] == kNoKey) continue;
    std::int32_t& current = owner[key_index(keys[i])];
    // Claimants come in ascending order, so an equal distance leaves the keypoint where it is.
    if (current >= 0 && key_distance(keys[i]) >= key_distance(keys[current])) continue;
    if (current < 0) ++count;
    current = static_cast<std::int32_t>(i);
  }
  for (std::size_t k = 0; k < num_keypoints; ++k) {
    if (owner[k] < 0) continue;
    keypoint[owner[k]] = static_cast<std::int32_t>(k);
    if (!distance.empty())
      distance[owner[k]] = static_cast<std::uint16_t>(key_distance(keys[owner[k]]));
  }
  return count;
}

}  // namespace fastloop::matching
