#pragma once

#include <vector>

#include "fastloop/matching/window_scan.hpp"

namespace fastloop::matching {

/// Keypoints in the order of their grid cells: those of neighbouring cells lie side by side, and a
/// window is a few runs that are compared eight at a time.
class OrderedKeypoints {
 public:
  OrderedKeypoints() = default;
  explicit OrderedKeypoints(const FeatureView& features);

  /// Whether this processor has the instructions (AVX2 and the population count).
  static bool supported();

  /// As scan_window of the same features, the same bits.
  MatchKey scan(const ScaleView& scales, const WindowScan& window, const Descriptor& query) const;

 private:
  FeatureView features_{};
  std::vector<float> x_, y_;           ///< [keypoints + 8]
  std::vector<std::uint8_t> octave_;   ///< [keypoints + 8]; blocked: 255, which no window accepts
};

}  // namespace fastloop::matching
