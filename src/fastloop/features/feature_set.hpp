#pragma once

#include <array>
#include <atomic>
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

/// Number of differing bits, 0..256. Counts in parallel within the words: without a flag that
/// promises a population count instruction std::popcount is a library call per word. For many
/// candidates at a time use hamming.hpp, which finds out what the CPU has.
constexpr int hamming_distance(const Descriptor& a, const Descriptor& b) {
  std::uint64_t bytes = 0;  // eight counters of one byte each, <= 32
  for (int i = 0; i < 4; ++i) {
    std::uint64_t v = a.words[i] ^ b.words[i];
    v -= (v >> 1) & 0x5555555555555555ULL;
    v = (v & 0x3333333333333333ULL) + ((v >> 2) & 0x3333333333333333ULL);
    bytes += (v + (v >> 4)) & 0x0f0f0f0f0f0f0f0fULL;
  }
  // Their sum can be 256, one more than a byte holds: add pairs first.
  bytes = (bytes & 0x00ff00ff00ff00ffULL) + ((bytes >> 8) & 0x00ff00ff00ff00ffULL);
  return static_cast<int>((bytes * 0x0001000100010001ULL) >> 48);
}

/// Scale pyramid of the extractor.
struct PyramidScales {
  int levels = 8;
  float factor = 1.2f;
  std::vector<float> scale;   ///< [levels] factor^level
  std::vector<float> sigma2;  ///< [levels] scale^2: variance of a keypoint's position, pixels^2

  /// @throws InvalidArgument on num_levels < 1 or > 255, or scale_factor <= 1.
  PyramidScales(int num_levels = 8, float scale_factor = 1.2f);
};

/// Keypoints of one image in cells of a regular grid: indices of cell (cx, cy) are
/// `indices[start[cy * cols + cx] .. start[cy * cols + cx + 1])`, ascending. No limit per cell.
struct KeypointGrid {
  static constexpr int kCols = 64, kRows = 48;
  float cell_width_px = 1, cell_height_px = 1;
  std::vector<std::uint32_t> start;    ///< [kCols * kRows + 1]
  std::vector<std::uint16_t> indices;  ///< [num_keypoints]

  /// Keypoints outside the image go to the nearest cell.
  /// @throws InvalidArgument on more than 65,535 keypoints, unequal extents or an empty image.
  void build(std::span<const float> x, std::span<const float> y, int image_width, int image_height);

  /// Column or row of the cell a pixel falls in, clamped to the grid.
  int column_of(float x_px) const { return clamped(x_px / cell_width_px, kCols); }
  int row_of(float y_px) const { return clamped(y_px / cell_height_px, kRows); }

 private:
  static int clamped(float cell, int count) {
    return !(cell > 0) ? 0 : cell >= static_cast<float>(count) ? count - 1 : static_cast<int>(cell);
  }
};

/// Names content that will not change any more, so that copies of it, on a device say, are found
/// again without comparing it. A copy of the object may be changed and therefore has no name.
class ContentId {
 public:
  ContentId() = default;
  ContentId(const ContentId&) noexcept {}
  ContentId& operator=(const ContentId&) noexcept {
    id_ = 0;
    return *this;
  }
  /// Names take no part in comparisons: equal content may have several.
  bool operator==(const ContentId&) const { return true; }
  /// 0 until somebody asked for a name.
  std::uint64_t value() const { return id_; }
  /// The name, given at the first call, unique in this process. To be called by those who know that
  /// the content stays, for example because they share it as const.
  std::uint64_t assign() const;

 private:
  mutable std::atomic<std::uint64_t> id_{0};
};

/// Features of one frame: structure of arrays, never changed after construction. Pixels of the
/// rig's left camera (rectified, or raw fisheye). Right coordinates are NaN and depth is <= 0 where
/// there is no stereo match. At most 65,535 keypoints.
struct FeatureSet {
  std::vector<float> x, y;              ///< [n] pixels
  std::vector<float> angle_rad;         ///< [n] orientation, [0, 2 pi)
  std::vector<std::uint8_t> octave;     ///< [n] pyramid level
  std::vector<Descriptor> descriptors;  ///< [n]
  std::vector<float> right_x, right_y;  ///< [n] pixels of the right camera
  std::vector<float> depth_m;           ///< [n] z in the left camera frame
  KeypointGrid grid;
  int image_width = 0, image_height = 0;
  ContentId id;

  std::size_t size() const { return x.size(); }
  bool has_depth(std::size_t i) const { return depth_m[i] > 0; }
};

}  // namespace fastloop
