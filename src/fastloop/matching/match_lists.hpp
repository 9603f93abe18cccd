#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace fastloop::matching {

/// A landmark and the keypoint that it won.
struct KeypointMatch {
  std::uint32_t landmark;
  std::uint16_t keypoint;
  std::uint16_t distance;  ///< Hamming
  bool operator==(const KeypointMatch&) const = default;
};

/// The matches of several targets and nothing else: as long as there are matches, not landmarks.
struct MatchLists {
  std::vector<KeypointMatch> matches;  ///< of a target: ascending keypoint
  std::vector<std::size_t> start{0};   ///< [targets + 1]
  std::size_t size() const { return start.size() - 1; }
  std::span<const KeypointMatch> operator[](std::size_t target) const {
    return std::span(matches).subspan(start[target], start[target + 1] - start[target]);
  }
  /// The matches of the next target.
  void append(std::span<const KeypointMatch> of_target) {
    matches.insert(matches.end(), of_target.begin(), of_target.end());
    start.push_back(matches.size());
  }
};

}  // namespace fastloop::matching
