#pragma once

#include <array>
#include <cstdint>

namespace fastloop {

/// One test of the descriptor: bit = intensity(x0, y0) < intensity(x1, y1). Pixels from the
/// keypoint, before rotation.
struct OrbTest {
  std::int8_t x0, y0, x1, y1;
  bool operator==(const OrbTest&) const = default;
};

/// Bit i of the descriptor is test i: the learned tests of the ORB paper (Rublee et al., ICCV
/// 2011), so that descriptors and vocabularies made elsewhere with standard ORB fit ours.
///
/// The numbers are measured, not copied: orb_pattern_test.cpp reads them off the public interface
/// of OpenCV's cv::ORB (Apache 2.0) with step images, compares them with this table, and writes the
/// table anew when the environment variable FASTLOOP_WRITE_ORB_PATTERN names a file.
inline constexpr std::array<OrbTest, 256> kOrbPattern{{
#include "fastloop/features/orb_pattern.inc"
}};

}  // namespace fastloop
