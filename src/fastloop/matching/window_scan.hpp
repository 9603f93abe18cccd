#pragma once

#include <cstdint>

#include "fastloop/compute/host_device.hpp"
#include "fastloop/features/feature_set.hpp"

namespace fastloop::matching {

/// Features of one image as raw pointers.
struct FeatureView {
  const float *x, *y, *right_x, *right_y;
  const std::uint8_t* octave;
  const Descriptor* descriptors;
  const std::uint32_t* cell_start;
  const std::uint16_t* cell_indices;
  const std::uint8_t* blocked;  ///< null: none
  float cell_width_px, cell_height_px;
  int size;
};

/// @throws InvalidArgument when `blocked` is neither empty nor as long as the features.
FeatureView make_feature_view(const FeatureSet& features, std::span<const std::uint8_t> blocked);

/// Scale and variance of each octave.
struct ScaleView {
  const float *scale, *sigma2;
  int levels;
};

/// A square window and the gates a keypoint in it must pass.
struct WindowScan {
  float u, v;                    ///< centre, pixels
  float radius;                  ///< half width, inclusive
  int min_octave, max_octave;    ///< inclusive
  float right_u, right_v;        ///< predicted right pixel; NaN fails the gates below
  float right_radius;            ///< of |right_u - keypoint's|, where it has one; < 0: no check
  float chi2_mono, chi2_stereo;  ///< <= 0: no gate
  int use_right_v;               ///< the right row takes part in the stereo gate
  int max_distance;              ///< Hamming, inclusive
  float best_to_second;          ///< >= 1: no ratio test
};

/// (distance << 16 | keypoint): ascending order is (distance, index).
using MatchKey = std::uint32_t;
inline constexpr MatchKey kNoKey = 0xffffffffu;

FASTLOOP_HD inline int key_distance(MatchKey key) {
  return static_cast<int>(key >> 16);
}
FASTLOOP_HD inline int key_index(MatchKey key) {
  return static_cast<int>(key & 0xffffu);
}

FASTLOOP_HD inline float magnitude(float a) {
  return a < 0 ? -a : a;
}

FASTLOOP_HD inline int clamp_cell(float cell, int cells) {
  if (!(cell > 0.0f)) return 0;
  return cell >= static_cast<float>(cells) ? cells - 1 : static_cast<int>(cell);
}

/// Position, octave and reprojection gates of keypoint `k`.
FASTLOOP_HD inline bool passes_gates(const FeatureView& f, const ScaleView& scales,
                                     const WindowScan& w, int k) {
  const int octave = f.octave[k];
  if (octave < w.min_octave || octave > w.max_octave) return false;
  const float dx = f.x[k] - w.u, dy = f.y[k] - w.v;
  if (!(magnitude(dx) <= w.radius) || !(magnitude(dy) <= w.radius)) return false;
  if (f.blocked && f.blocked[k]) return false;
  const float right_x = f.right_x[k];
  const bool has_right = right_x == right_x;
  if (has_right && w.right_radius >= 0.0f && !(magnitude(right_x - w.right_u) <= w.right_radius))
    return false;
  const float error2 = dx * dx + dy * dy;
  if (has_right && w.chi2_stereo > 0.0f) {
    const float du = right_x - w.right_u;
    const float dv = w.use_right_v ? f.right_y[k] - w.right_v : 0.0f;
    return error2 + (du * du + dv * dv) <= w.chi2_stereo * scales.sigma2[octave];
  }
  return !(w.chi2_mono > 0.0f) || error2 <= w.chi2_mono * scales.sigma2[octave];
}

/// Smallest and second smallest key.
struct BestTwo {
  MatchKey best = kNoKey, second = kNoKey;
  FASTLOOP_HD void take(MatchKey key) {
    if (key < best) {
      second = best;
      best = key;
    } else if (key < second) {
      second = key;
    }
  }
};

inline constexpr float kWindowMargin = 0.01f;  ///< pixels; covers rounding of the cell borders

/// What a window found, after the limits on the distance.
FASTLOOP_HD inline MatchKey best_of(const FeatureView& f, const WindowScan& w,
                                    const BestTwo& found) {
  if (found.best == kNoKey || key_distance(found.best) > w.max_distance) return kNoKey;
  if (w.best_to_second < 1.0f && found.second != kNoKey &&
      f.octave[key_index(found.best)] == f.octave[key_index(found.second)] &&
      static_cast<float>(key_distance(found.best)) >
          w.best_to_second * static_cast<float>(key_distance(found.second)))
    return kNoKey;
  return found.best;
}

/// The best keypoint of a window, or kNoKey. Independent of the order in which keypoints are
/// visited. `Distances` computes the Hamming distances of a batch:
///   void operator()(const Descriptor& query, const Descriptor* all, const std::uint16_t* indices,
///   int n,
///                   std::uint16_t* out)
template <class Distances>
FASTLOOP_HD inline MatchKey scan_window(const FeatureView& f, const ScaleView& scales,
                                        const WindowScan& w, const Descriptor& query,
                                        const Distances& distances) {
  constexpr int kBatch = 64;
  constexpr int kCols = KeypointGrid::kCols, kRows = KeypointGrid::kRows;
  if (f.size == 0) return kNoKey;
  const float reach = w.radius + kWindowMargin;
  const int first_col = clamp_cell((w.u - reach) / f.cell_width_px, kCols);
  const int last_col = clamp_cell((w.u + reach) / f.cell_width_px, kCols);
  const int first_row = clamp_cell((w.v - reach) / f.cell_height_px, kRows);
  const int last_row = clamp_cell((w.v + reach) / f.cell_height_px, kRows);

  std::uint16_t batch[kBatch], distance[kBatch];
  int batched = 0;
  BestTwo found;
  for (int row = first_row; row <= last_row; ++row) {
    // The cells of one row are neighbours in the index list.
    const std::uint32_t begin = f.cell_start[row * kCols + first_col];
    const std::uint32_t end = f.cell_start[row * kCols + last_col + 1];
    for (std::uint32_t i = begin; i < end; ++i) {
      const std::uint16_t k = f.cell_indices[i];
      if (!passes_gates(f, scales, w, k)) continue;
      batch[batched++] = k;
      if (batched < kBatch) continue;
      distances(query, f.descriptors, batch, batched, distance);
      for (int j = 0; j < batched; ++j)
        found.take(static_cast<MatchKey>(distance[j]) << 16 | batch[j]);
      batched = 0;
    }
  }
  distances(query, f.descriptors, batch, batched, distance);
  for (int j = 0; j < batched; ++j) found.take(static_cast<MatchKey>(distance[j]) << 16 | batch[j]);
  return best_of(f, w, found);
}

}  // namespace fastloop::matching
