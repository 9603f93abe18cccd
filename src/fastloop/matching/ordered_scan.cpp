#include "fastloop/matching/ordered_scan.hpp"

#include "fastloop/matching/batch_distances.hpp"

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#endif

namespace fastloop::matching {
namespace {

constexpr int kLanes = 8;  // keypoints compared at a time
constexpr std::uint8_t kNever = 255;

}  // namespace

OrderedKeypoints::OrderedKeypoints(const FeatureView& features) : features_(features) {
  const auto n = static_cast<std::size_t>(features.size);
  x_.resize(n + kLanes);
  y_.resize(n + kLanes);
  octave_.resize(n + kLanes, kNever);
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint16_t k = features.cell_indices[i];
    x_[i] = features.x[k];
    y_[i] = features.y[k];
    octave_[i] = features.blocked && features.blocked[k] ? kNever : features.octave[k];
  }
}

#if defined(__x86_64__) && defined(__GNUC__)

namespace {

struct Cells {
  int first_col, last_col, first_row, last_row;
};

/// The cells a window touches, as scan_window finds them.
__attribute__((target("avx2"), always_inline)) inline Cells cells_of(const FeatureView& f,
                                                                     const WindowScan& w) {
  const float reach = w.radius + kWindowMargin;
  const __m128 width = _mm_set1_ps(f.cell_width_px), height = _mm_set1_ps(f.cell_height_px);
  const __m128 size = _mm_shuffle_ps(width, height, 0);
  const __m128 pixel = _mm_setr_ps(w.u - reach, w.u + reach, w.v - reach, w.v + reach);
  const auto cols = static_cast<float>(KeypointGrid::kCols - 1);
  const auto rows = static_cast<float>(KeypointGrid::kRows - 1);
  // The second operand is taken for NaN: cell 0.
  __m128 cell = _mm_max_ps(_mm_div_ps(pixel, size), _mm_setzero_ps());
  cell = _mm_min_ps(cell, _mm_setr_ps(cols, cols, rows, rows));
  alignas(16) int out[4];
  _mm_store_si128(reinterpret_cast<__m128i*>(out), _mm_cvttps_epi32(cell));
  return {out[0], out[1], out[2], out[3]};
}

__attribute__((target("popcnt"), always_inline)) inline MatchKey key_of(const Descriptor& a,
                                                                        const Descriptor& b,
                                                                        std::uint16_t k) {
  const int distance = __builtin_popcountll(a.words[0] ^ b.words[0]) +
                       __builtin_popcountll(a.words[1] ^ b.words[1]) +
                       __builtin_popcountll(a.words[2] ^ b.words[2]) +
                       __builtin_popcountll(a.words[3] ^ b.words[3]);
  return static_cast<MatchKey>(distance) << 16 | k;
}

}  // namespace

bool OrderedKeypoints::supported() {
  static const bool has = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("popcnt");
  return has;
}

__attribute__((target("avx2,popcnt"))) MatchKey OrderedKeypoints::scan(
    const ScaleView& scales, const WindowScan& w, const Descriptor& query) const {
  const FeatureView& f = features_;
  if (f.size == 0) return kNoKey;
  const Cells cells = cells_of(f, w);
  const bool more_gates = w.right_radius >= 0.0f || w.chi2_mono > 0.0f || w.chi2_stereo > 0.0f;
  const __m256 u = _mm256_set1_ps(w.u), v = _mm256_set1_ps(w.v), radius = _mm256_set1_ps(w.radius);
  const __m256 sign = _mm256_set1_ps(-0.0f);
  const __m256i below = _mm256_set1_epi32(w.min_octave - 1), above = _mm256_set1_epi32(w.max_octave + 1);
  BestTwo found;
  for (int row = cells.first_row; row <= cells.last_row; ++row) {
    const std::uint32_t* start = f.cell_start + row * KeypointGrid::kCols;
    std::uint32_t i = start[cells.first_col];
    const std::uint32_t end = start[cells.last_col + 1];
    for (; i < end; i += kLanes) {
      const __m256 dx = _mm256_andnot_ps(sign, _mm256_loadu_ps(&x_[i]) - u);
      const __m256 dy = _mm256_andnot_ps(sign, _mm256_loadu_ps(&y_[i]) - v);
      const __m256 near = _mm256_and_ps(_mm256_cmp_ps(dx, radius, _CMP_LE_OQ),
                                        _mm256_cmp_ps(dy, radius, _CMP_LE_OQ));
      const __m256i octave = _mm256_cvtepu8_epi32(
          _mm_loadl_epi64(reinterpret_cast<const __m128i*>(&octave_[i])));
      const __m256i accepted = _mm256_and_si256(_mm256_cmpgt_epi32(octave, below),
                                                _mm256_cmpgt_epi32(above, octave));
      auto pass = static_cast<unsigned>(
          _mm256_movemask_ps(_mm256_and_ps(near, _mm256_castsi256_ps(accepted))));
      if (end - i < kLanes) pass &= (1u << (end - i)) - 1u;
      for (; pass != 0; pass &= pass - 1) {
        const std::uint16_t k =
            f.cell_indices[i + static_cast<unsigned>(__builtin_ctz(pass))];
        if (more_gates && !passes_gates(f, scales, w, k)) continue;
        found.take(key_of(query, f.descriptors[k], k));
      }
    }
  }
  return best_of(f, w, found);
}

#else

bool OrderedKeypoints::supported() {
  return false;
}

MatchKey OrderedKeypoints::scan(const ScaleView& scales, const WindowScan& window,
                                const Descriptor& query) const {
  return scan_window(features_, scales, window, query, PortableDistances{});
}

#endif

}  // namespace fastloop::matching
