#pragma once

#include <array>
#include <cstdint>
#include <span>

namespace fastloop::matching {

/// Votes of matches for the change of orientation between two images: a wrong match seldom turns
/// its keypoint as the others do. 30 bins over the full turn; the three fullest are believed (ties:
/// lower bin).
class RotationHistogram {
 public:
  static constexpr int kBins = 30, kKept = 3;

  /// Bin of a change of orientation, any finite angle in radians.
  static int bin(float change_rad);

  void add(int bin) { ++count_[bin]; }

  /// [kBins] true for the bins that are believed.
  std::array<bool, kBins> kept() const;

 private:
  std::array<int, kBins> count_{};
};

/// Sets to kNoMatch the matches whose change of orientation is not among the most frequent. A match
/// with a NaN angle neither votes nor is dropped.
///
/// @param first_angle_rad   [matches.size()]
/// @param second_angle_rad  [any] indexed by the matches
void drop_odd_rotations(std::span<const float> first_angle_rad,
                        std::span<const float> second_angle_rad, std::span<std::int32_t> matches);

}  // namespace fastloop::matching
