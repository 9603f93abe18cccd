#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/matching/descriptor_matching.hpp"

namespace fastloop::matching {

/// @throws InvalidArgument on missing features, unequal extents or indices out of range
void check_side(const MatchSide& side);

/// For every keypoint of one image the keypoints of another it is compared with: those of its
/// vocabulary group, or all. Blocked keypoints of either side are left out.
class CandidateLists {
 public:
  /// @throws InvalidArgument on missing features, unequal extents or indices out of range
  CandidateLists(const MatchSide& first, const MatchSide& second);

  /// Ascending indices in `second`; empty for a keypoint that takes no part.
  std::span<const std::uint16_t> of(std::size_t keypoint) const {
    const Range r = range_[keypoint];
    return {indices_.data() + r.begin, r.end - r.begin};
  }

 private:
  struct Range {
    std::uint32_t begin = 0, end = 0;
  };
  void compare_all(const MatchSide& first, const MatchSide& second);
  void compare_groups(const MatchSide& first, const MatchSide& second);

  std::vector<std::uint16_t> indices_;
  std::vector<Range> range_;  ///< [keypoints of first]
};

}  // namespace fastloop::matching
