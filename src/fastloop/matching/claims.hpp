#pragma once

#include <cstdint>
#include <span>

#include "fastloop/matching/projection_search.hpp"
#include "fastloop/matching/window_scan.hpp"

namespace fastloop::matching {

/// One keypoint to one claimant: among the claims on a keypoint the smallest (distance, claimant)
/// wins, the others get kNoMatch.
///
/// @param keys           [n] best keypoint of each claimant, or kNoKey
/// @param[out] keypoint  [n]
/// @param[out] distance  [n] 0 where unmatched; may be empty
/// @return number of matches
int resolve_claims(std::span<const MatchKey> keys, std::size_t num_keypoints,
                   std::span<std::int32_t> keypoint, std::span<std::uint16_t> distance);

}  // namespace fastloop::matching
