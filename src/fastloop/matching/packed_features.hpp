#pragma once

#include <cstddef>
#include <cstdint>

#include "fastloop/compute/host_device.hpp"
#include "fastloop/matching/projection_math.hpp"

/// What searches read as blocks of memory that can be copied anywhere. Features of one image:
/// keypoints in the order of their grid cells, so that a row of a window is one run, and what is read
/// together side by side. Landmarks: their arrays one after another.
namespace fastloop::matching {

/// What the gates of a window read, in one load.
struct alignas(16) PackedKeypoint {
  float x, y, right_x;
  std::uint32_t tag;  ///< octave << 16 | index of the keypoint in the feature set
  FASTLOOP_HD int index() const { return static_cast<int>(tag & 0xffffu); }
  FASTLOOP_HD int octave() const { return static_cast<int>(tag >> 16); }
};

struct PackedView {
  const PackedKeypoint* keypoints;  ///< [size] cell order, and so the next two
  const Descriptor* descriptors;
  const float* right_y;
  const std::uint16_t* cell_start;  ///< [cells + 1]
  const std::uint16_t* position;    ///< [size] of a keypoint, by its index in the feature set
  float cell_width_px, cell_height_px;
  int size;
};

inline constexpr std::size_t kPackedCells = KeypointGrid::kCols * KeypointGrid::kRows;

/// Bytes of a packed set of n keypoints: 54 for each and 6 kB.
FASTLOOP_HD constexpr std::size_t packed_bytes(std::size_t n) {
  return n * (sizeof(PackedKeypoint) + sizeof(Descriptor) + sizeof(float)) +
         (n + kPackedCells + 1) * sizeof(std::uint16_t);
}

/// @param out  [packed_bytes(features.size())] aligned to 16
/// @throws InvalidArgument when the arrays or the grid do not fit the number of keypoints
void pack_features(const FeatureSet& features, std::byte* out);

/// The arrays in a block that pack_features wrote, wherever it lies now.
FASTLOOP_HD inline PackedView packed_view(const std::byte* block, int size, float cell_width_px,
                                          float cell_height_px) {
  const auto n = static_cast<std::size_t>(size);
  PackedView v;
  v.keypoints = reinterpret_cast<const PackedKeypoint*>(block);
  block += n * sizeof(PackedKeypoint);
  v.descriptors = reinterpret_cast<const Descriptor*>(block);
  block += n * sizeof(Descriptor);
  v.right_y = reinterpret_cast<const float*>(block);
  block += n * sizeof(float);
  v.cell_start = reinterpret_cast<const std::uint16_t*>(block);
  block += (kPackedCells + 1) * sizeof(std::uint16_t);
  v.position = reinterpret_cast<const std::uint16_t*>(block);
  v.cell_width_px = cell_width_px;
  v.cell_height_px = cell_height_px;
  v.size = size;
  return v;
}

FASTLOOP_HD inline int octave_of(const PackedView& f, int keypoint) {
  return f.keypoints[f.position[keypoint]].octave();
}

/// A keypoint for passes_gates.
struct KeypointOfPack {
  PackedKeypoint k;
  const float* right_row;
  const std::uint8_t* is_blocked;  ///< [size] by index; null: none
  FASTLOOP_HD float x() const { return k.x; }
  FASTLOOP_HD float y() const { return k.y; }
  FASTLOOP_HD float right_x() const { return k.right_x; }
  FASTLOOP_HD float right_y() const { return *right_row; }
  FASTLOOP_HD int octave() const { return k.octave(); }
  FASTLOOP_HD bool blocked() const { return is_blocked && is_blocked[k.index()]; }
};

/// The share of one of `lanes` workers in the scan of a window: every lanes-th row of cells. All
/// shares merged are what scan_window finds. `Distance`: int operator()(position in the pack).
template <class Distance>
FASTLOOP_HD inline BestTwo scan_rows(const PackedView& f, const std::uint8_t* blocked,
                                     const ScaleView& scales, const WindowScan& w,
                                     const Distance& distance, int lane, int lanes) {
  BestTwo found;
  const CellRange cells = cells_of(w, f.cell_width_px, f.cell_height_px);
  for (int row = cells.first_row + lane; row <= cells.last_row; row += lanes) {
    const std::uint16_t* start = f.cell_start + row * KeypointGrid::kCols;
    const int end = start[cells.last_col + 1];
    for (int i = start[cells.first_col]; i < end; ++i) {
      const KeypointOfPack k{f.keypoints[i], f.right_y + i, blocked};
      if (passes_gates(k, scales, w))
        found.take(static_cast<MatchKey>(distance(i)) << 16 | static_cast<MatchKey>(k.k.index()));
    }
  }
  return found;
}

/// Bytes of n packed landmarks.
FASTLOOP_HD constexpr std::size_t packed_landmark_bytes(std::size_t n) {
  return n * (sizeof(Descriptor) + 8 * sizeof(float));
}

/// @param out  [packed_landmark_bytes(n)] aligned to 16; without normals those stay unwritten
void pack_landmarks(const LandmarkArrays& landmarks, std::size_t n, std::byte* out);

/// The arrays in a block of n packed landmarks.
FASTLOOP_HD inline LandmarkArrays packed_landmarks(const std::byte* block, std::size_t n) {
  LandmarkArrays a;
  a.descriptor = reinterpret_cast<const Descriptor*>(block);
  a.p_world = reinterpret_cast<const float*>(block + n * sizeof(Descriptor));
  a.normal_world = a.p_world + 3 * n;
  a.min_distance_m = a.p_world + 6 * n;
  a.max_distance_m = a.p_world + 7 * n;
  return a;
}

}  // namespace fastloop::matching
