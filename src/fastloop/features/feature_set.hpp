#pragma once

#include <array>
#include <bit>
#include <cstdint>
#include <cstring>
#include <span>
#include <vector>

namespace fastloop {

/// 256-bit binary descriptor (ORB, rotated BRIEF), as four 64-bit words.
struct Descriptor {
  std::array<std::uint64_t, 4> words{};
  bool operator==(const Descriptor&) const = default;
};
static_assert(sizeof(Descriptor) == 32);

/// Number of differing bits, 0..256.
inline int hamming_distance(const Descriptor& a, const Descriptor& b) {
  int d = 0;
  for (int i = 0; i < 4; ++i) d += std::popcount(a.words[i] ^ b.words[i]);
  return d;
}

/// Scale pyramid of the extractor.
struct PyramidScales {
  int levels = 8;
  float factor = 1.2f;
  std::vector<float> scale;       ///< [levels] factor^level
  std::vector<float> sigma2;      ///< [levels] scale^2: variance of a keypoint's position, pixels^2

  PyramidScales(int num_levels = 8, float scale_factor = 1.2f);
};

/// Keypoints of one image in cells of a regular grid: indices of cell (cx, cy) are
/// `indices[start[cy * cols + cx] .. start[cy * cols + cx + 1])`, ascending. No limit per cell.
struct KeypointGrid {
  static constexpr int kCols = 64, kRows = 48;
  float cell_width_px = 1, cell_height_px = 1;
  std::vector<std::uint32_t> start;    ///< [kCols * kRows + 1]
  std::vector<std::uint16_t> indices;  ///< [num_keypoints]

  void build(std::span<const float> x, std::span<const float> y, int image_width, int image_height);
};

/// Features of one frame: structure of arrays, never changed after construction. Pixels of the rig's
/// left camera (rectified, or raw fisheye). Right coordinates are NaN and depth is <= 0 where there is
/// no stereo match. At most 65,535 keypoints.
struct FeatureSet {
  std::vector<float> x, y;              ///< [n] pixels
  std::vector<float> angle_rad;         ///< [n] orientation, [0, 2 pi)
  std::vector<std::uint8_t> octave;     ///< [n] pyramid level
  std::vector<Descriptor> descriptors;  ///< [n]
  std::vector<float> right_x, right_y;  ///< [n] pixels of the right camera
  std::vector<float> depth_m;           ///< [n] z in the left camera frame
  KeypointGrid grid;
  int image_width = 0, image_height = 0;

  std::size_t size() const { return x.size(); }
  bool has_depth(std::size_t i) const { return depth_m[i] > 0; }
};

}  // namespace fastloop
