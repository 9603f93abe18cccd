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

/// Position, octave and reprojection gates of a keypoint. `Keypoint` reads what is asked for: x(),
/// y(), right_x(), right_y(), octave(), blocked().
template <class Keypoint>
FASTLOOP_HD inline bool passes_gates(const Keypoint& k, const ScaleView& scales,
                                     const WindowScan& w) {
  const int octave = k.octave();
  if (octave < w.min_octave || octave > w.max_octave) return false;
  const float dx = k.x() - w.u, dy = k.y() - w.v;
  if (!(magnitude(dx) <= w.radius) || !(magnitude(dy) <= w.radius)) return false;
  if (k.blocked()) return false;
  const float right_x = k.right_x();
  const bool has_right = right_x == right_x;
  if (has_right && w.right_radius >= 0.0f && !(magnitude(right_x - w.right_u) <= w.right_radius))
    return false;
  const float error2 = dx * dx + dy * dy;
  if (has_right && w.chi2_stereo > 0.0f) {
    const float du = right_x - w.right_u;
    const float dv = w.use_right_v ? k.right_y() - w.right_v : 0.0f;
    return error2 + (du * du + dv * dv) <= w.chi2_stereo * scales.sigma2[octave];
  }
  return !(w.chi2_mono > 0.0f) || error2 <= w.chi2_mono * scales.sigma2[octave];
}

/// Keypoint `k` of a feature set.
struct KeypointOfView {
  const FeatureView& f;
  int k;
  FASTLOOP_HD float x() const { return f.x[k]; }
  FASTLOOP_HD float y() const { return f.y[k]; }
  FASTLOOP_HD float right_x() const { return f.right_x[k]; }
  FASTLOOP_HD float right_y() const { return f.right_y[k]; }
  FASTLOOP_HD int octave() const { return f.octave[k]; }
  FASTLOOP_HD bool blocked() const { return f.blocked && f.blocked[k]; }
};

FASTLOOP_HD inline bool passes_gates(const FeatureView& f, const ScaleView& scales,
                                     const WindowScan& w, int k) {
  return passes_gates(KeypointOfView{f, k}, scales, w);
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
  /// Takes what another one took; no key may be in both.
  FASTLOOP_HD void merge(const BestTwo& o) {
    take(o.best);
    take(o.second);
  }
};

inline constexpr float kWindowMargin = 0.01f;  ///< pixels; covers rounding of the cell borders

/// The cells that a window touches.
struct CellRange {
  int first_col, last_col, first_row, last_row;
};

FASTLOOP_HD inline CellRange cells_of(const WindowScan& w, float cell_width_px,
                                      float cell_height_px) {
  const float reach = w.radius + kWindowMargin;
  return {clamp_cell((w.u - reach) / cell_width_px, KeypointGrid::kCols),
          clamp_cell((w.u + reach) / cell_width_px, KeypointGrid::kCols),
          clamp_cell((w.v - reach) / cell_height_px, KeypointGrid::kRows),
          clamp_cell((w.v + reach) / cell_height_px, KeypointGrid::kRows)};
}

FASTLOOP_HD inline int octave_of(const FeatureView& f, int keypoint) {
  return f.octave[keypoint];
}

/// What a window found, after the limits on the distance.
template <class Features>
FASTLOOP_HD inline MatchKey best_of(const Features& f, const WindowScan& w, const BestTwo& found) {
  if (found.best == kNoKey || key_distance(found.best) > w.max_distance) return kNoKey;
  if (w.best_to_second < 1.0f && found.second != kNoKey &&
      octave_of(f, key_index(found.best)) == octave_of(f, key_index(found.second)) &&
      static_cast<float>(key_distance(found.best)) >
          w.best_to_second * static_cast<float>(key_distance(found.second)))
    return kNoKey;
  return found.best;
}

/// The nearest descriptor, or kNoKey where it is too far or the second is about as near.
FASTLOOP_HD inline MatchKey nearest_of(const BestTwo& found, int max_distance,
                                       float best_to_second) {
  if (found.best == kNoKey || key_distance(found.best) > max_distance) return kNoKey;
  if (best_to_second < 1 && found.second != kNoKey &&
      !(static_cast<float>(key_distance(found.best)) <
        best_to_second * static_cast<float>(key_distance(found.second))))
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
  constexpr int kCols = KeypointGrid::kCols;
  if (f.size == 0) return kNoKey;
  const CellRange cells = cells_of(w, f.cell_width_px, f.cell_height_px);

  std::uint16_t batch[kBatch], distance[kBatch];
  int batched = 0;
  BestTwo found;
  for (int row = cells.first_row; row <= cells.last_row; ++row) {
    // The cells of one row are neighbours in the index list.
    const std::uint32_t begin = f.cell_start[row * kCols + cells.first_col];
    const std::uint32_t end = f.cell_start[row * kCols + cells.last_col + 1];
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
