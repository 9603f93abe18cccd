#pragma once

#include <cstdint>

#include "fastloop/features/feature_set.hpp"
#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// Pixels around a keypoint that `patch_direction` and `describe` read: keypoints must keep this
/// distance from the edge of their level.
inline constexpr int kOrbBorderPx = 19;

/// Unit direction from the keypoint to the intensity centroid of the disc of radius 15 around it.
struct PatchDirection {
  float cos = 1, sin = 0;
};
PatchDirection patch_direction(const ImageU8& level, int x, int y);

/// Rotated BRIEF, bit for bit that of standard ORB. `blurred` is the level after a Gaussian of 7 x
/// 7 pixels, sigma 2.
Descriptor describe(const ImageU8& blurred, int x, int y, PatchDirection direction);

}  // namespace fastloop
