#include "fastloop/features/orb_descriptor.hpp"

#include <array>
#include <cmath>

#include "fastloop/features/orb_pattern.hpp"

namespace fastloop {
namespace {

constexpr int kRadius = 15;
constexpr int kRowLength = 32;  ///< one more than the disc, for whole vectors; its weight is zero

/// Weights u and v of the pixels (u, v) of the disc, zero outside it.
struct DiscWeights {
  alignas(32) std::array<std::array<std::int16_t, kRowLength>, 2 * kRadius + 1> u{}, v{};

  DiscWeights() {
    // Half widths of the rows: rounded up to the diagonal and mirrored beyond it, so that the disc
    // is the same seen along x and along y.
    const auto rounded = [](int y) {
      return static_cast<int>(std::lround(std::sqrt(double(kRadius * kRadius - y * y))));
    };
    const int diagonal = static_cast<int>(std::lround(kRadius / std::sqrt(2.0)));
    std::array<int, kRadius + 1> half{};
    for (int y = 0; y <= kRadius; ++y) {
      if (y <= diagonal) half[y] = rounded(y);
      for (int x = 0; y > diagonal && x <= diagonal; ++x)
        if (rounded(x) >= y) half[y] = x;
    }
    for (int y = -kRadius; y <= kRadius; ++y)
      for (int x = -half[std::abs(y)]; x <= half[std::abs(y)]; ++x) {
        u[y + kRadius][x + kRadius] = static_cast<std::int16_t>(x);
        v[y + kRadius][x + kRadius] = static_cast<std::int16_t>(y);
      }
  }
};

/// The pattern as arrays of floats: all first points, then all second points.
struct PatternPoints {
  static constexpr int kCount = 2 * static_cast<int>(kOrbPattern.size());
  alignas(32) std::array<float, kCount> x{}, y{};

  PatternPoints() {
    for (std::size_t i = 0; i < kOrbPattern.size(); ++i) {
      x[i] = kOrbPattern[i].x0;
      y[i] = kOrbPattern[i].y0;
      x[i + kOrbPattern.size()] = kOrbPattern[i].x1;
      y[i + kOrbPattern.size()] = kOrbPattern[i].y1;
    }
  }
};

const DiscWeights kDisc;
const PatternPoints kPoints;

/// Nearest integer, ties to even, of |value| < 2^22: beside 1.5 * 2^23 there is no room for a
/// fraction. Unlike lrint this compiles to vector code.
__attribute__((always_inline)) inline float rounded(float value) {
  constexpr float kShift = 12582912.0f;
  return (value + kShift) - kShift;
}

/// Memory offsets of the turned pattern. In float all the way: exact below 2^24, and there is no
/// vector multiplication of 32-bit integers on a plain x86-64.
__attribute__((always_inline)) inline void pattern_offsets(const PatternPoints& points,
                                                           PatchDirection d, float stride,
                                                           std::int32_t* __restrict offset) {
  for (int i = 0; i < PatternPoints::kCount; ++i) {
    const float dx = rounded(points.x[i] * d.cos - points.y[i] * d.sin);
    const float dy = rounded(points.x[i] * d.sin + points.y[i] * d.cos);
    offset[i] = static_cast<std::int32_t>(dy * stride + dx);
  }
}

void pattern_offsets_portable(const PatternPoints& points, PatchDirection d, float stride,
                              std::int32_t* offset) {
  pattern_offsets(points, d, stride, offset);
}
#if defined(__x86_64__)
__attribute__((target("avx2"))) void pattern_offsets_avx2(const PatternPoints& points,
                                                          PatchDirection d, float stride,
                                                          std::int32_t* offset) {
  pattern_offsets(points, d, stride, offset);
}
const bool kHasAvx2 = __builtin_cpu_supports("avx2");
#else
constexpr auto pattern_offsets_avx2 = pattern_offsets_portable;
constexpr bool kHasAvx2 = false;
#endif

}  // namespace

PatchDirection patch_direction(const ImageU8& level, int x, int y) {
  std::int32_t m10 = 0, m01 = 0;
  for (int row = 0; row < 2 * kRadius + 1; ++row) {
    const std::uint8_t* pixels = level.row(y + row - kRadius) + x - kRadius;
    const auto& u = kDisc.u[row];
    const auto& v = kDisc.v[row];
    for (int i = 0; i < kRowLength; ++i) {
      const std::int16_t value = pixels[i];
      m10 += value * u[i];
      m01 += value * v[i];
    }
  }
  if (m10 == 0 && m01 == 0) return {};
  const float norm = std::hypot(static_cast<float>(m10), static_cast<float>(m01));
  return {static_cast<float>(m10) / norm, static_cast<float>(m01) / norm};
}

Descriptor describe(const ImageU8& blurred, int x, int y, PatchDirection direction) {
  constexpr int kCount = PatternPoints::kCount, kBits = kCount / 2;
  alignas(32) std::array<std::int32_t, kCount> offset;
  (kHasAvx2 ? pattern_offsets_avx2 : pattern_offsets_portable)(
      kPoints, direction, static_cast<float>(blurred.width), offset.data());
  const std::uint8_t* centre = blurred.row(y) + x;
  Descriptor descriptor;
  for (int word = 0; word < 4; ++word) {
    std::uint64_t bits = 0;
    for (int i = 0; i < 64; ++i) {
      const int k = word * 64 + i;
      const std::uint64_t bit = centre[offset[k]] < centre[offset[k + kBits]];
      bits |= bit << i;
    }
    descriptor.words[word] = bits;
  }
  return descriptor;
}

}  // namespace fastloop
