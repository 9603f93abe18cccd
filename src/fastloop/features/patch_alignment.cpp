#include "fastloop/features/patch_alignment.hpp"

#include <algorithm>
#include <cmath>

namespace fastloop {
namespace {

constexpr int kHalf = PatchTemplate::kHalf, kSize = PatchTemplate::kSize,
              kPixels = PatchTemplate::kPixels;
constexpr float kMinNorm = 1e-3f;
constexpr int kMaxIterations = 8;
constexpr float kStopPx = 0.01f;

using Samples = std::array<float, kPixels>;

float mean_of(const Samples& v) {
  float sum = 0;
  for (int i = 0; i < kPixels; ++i) sum += v[i];
  return sum / kPixels;
}

/// Correlation of raw samples with the template, and the Gauss-Newton step of the shift.
struct Comparison {
  float correlation = 0, step_px = 0;
};

Comparison compare(const PatchTemplate& patch, const Samples& samples) {
  // The template's values have zero mean, so the samples' mean drops out of the products.
  const float mean = mean_of(samples);
  float cross = 0, square = 0, slope = 0, own_slope = 0;
  for (int i = 0; i < kPixels; ++i) {
    const float v = samples[i] - mean;
    cross += v * patch.value[i];
    square += v * v;
    slope += v * patch.gradient[i];
    own_slope += patch.value[i] * patch.gradient[i];
  }
  const float norm = std::sqrt(square);
  if (norm < kMinNorm || patch.norm < kMinNorm || patch.gradient_sq < kMinNorm) return {};
  // samples = contrast * template(shifted): bring the samples to the template's contrast.
  return {cross / (norm * patch.norm), (own_slope - slope * patch.norm / norm) / patch.gradient_sq};
}

/// Bilinear samples under the line's warp. False when they would leave the image.
bool sample(const ImageU8& image, const PatchLine& line, float shift, Samples& out) {
  const float cx = line.x + shift * line.dx, cy = line.y + shift * line.dy;
  const float reach_x = kHalf * (std::abs(line.warp[0]) + std::abs(line.warp[1]));
  const float reach_y = kHalf * (std::abs(line.warp[2]) + std::abs(line.warp[3]));
  if (!(cx - reach_x >= 0 && cy - reach_y >= 0 &&
        cx + reach_x < static_cast<float>(image.width - 1) &&
        cy + reach_y < static_cast<float>(image.height - 1)))
    return false;
  int k = 0;
  for (int v = -kHalf; v <= kHalf; ++v) {
    for (int u = -kHalf; u <= kHalf; ++u, ++k) {
      const float x = cx + line.warp[0] * u + line.warp[1] * v;
      const float y = cy + line.warp[2] * u + line.warp[3] * v;
      const int ix = static_cast<int>(x), iy = static_cast<int>(y);
      const float fx = x - ix, fy = y - iy;
      const std::uint8_t* p = image.pixels.data() + static_cast<std::size_t>(iy) * image.width + ix;
      const std::uint8_t* q = p + image.width;
      const float top = p[0] + fx * (p[1] - p[0]), bottom = q[0] + fx * (q[1] - q[0]);
      out[k] = top + fy * (bottom - top);
    }
  }
  return true;
}

/// Samples of whole rows at a fractional column. The patch must lie in the image.
void sample_row(const ImageU8& image, float x, int y, Samples& out) {
  const int ix = static_cast<int>(std::floor(x));
  const float f = x - ix;
  int k = 0;
  for (int v = -kHalf; v <= kHalf; ++v) {
    const std::uint8_t* p = image.row(y + v) + ix - kHalf;
    for (int u = 0; u < kSize; ++u, ++k) out[k] = p[u] + f * (p[u + 1] - p[u]);
  }
}

/// Gauss-Newton on the shift. `sample_at(shift, samples)` is false outside the image.
template <class SampleAt>
PatchFit iterate(const PatchTemplate& patch, float start, float max_shift_px, SampleAt sample_at) {
  PatchFit fit;
  fit.shift_px = start;
  Samples samples;
  for (int i = 0; i < kMaxIterations; ++i) {
    if (!(std::abs(fit.shift_px) <= max_shift_px) || !sample_at(fit.shift_px, samples)) return fit;
    const Comparison c = compare(patch, samples);
    fit.correlation = c.correlation;
    if (c.correlation == 0) return fit;
    fit.shift_px += std::clamp(c.step_px, -1.0f, 1.0f);
    if (std::abs(c.step_px) < kStopPx) {
      fit.converged = true;
      return fit;
    }
  }
  return fit;
}

}  // namespace

PatchTemplate::PatchTemplate(const ImageU8& image, int x, int y, float dx, float dy) {
  int k = 0;
  for (int v = -kHalf; v <= kHalf; ++v) {
    const std::uint8_t* p = image.row(y + v) + x - kHalf;
    const std::uint8_t* above = p - image.width;
    const std::uint8_t* below = p + image.width;
    for (int u = 0; u < kSize; ++u, ++k) {
      value[k] = p[u];
      gradient[k] = 0.5f * (dx * (p[u + 1] - p[u - 1]) + dy * (below[u] - above[u]));
    }
  }
  const float mean = mean_of(value), gradient_mean = mean_of(gradient);
  float square = 0;
  for (int i = 0; i < kPixels; ++i) {
    value[i] -= mean;
    gradient[i] -= gradient_mean;
    square += value[i] * value[i];
    gradient_sq += gradient[i] * gradient[i];
  }
  norm = std::sqrt(square);
}

PatchFit align_along_line(const PatchTemplate& patch, const ImageU8& image, const PatchLine& line,
                          float max_shift_px) {
  return iterate(patch, 0, max_shift_px, [&](float shift, Samples& samples) {
    return sample(image, line, shift, samples);
  });
}

PatchFit align_along_row(const PatchTemplate& patch, const ImageU8& image, int x, int y,
                         int search_px) {
  const auto inside = [&](float centre) {
    return centre - kHalf >= 0 && centre + kHalf + 1 < static_cast<float>(image.width);
  };
  if (y - kHalf < 0 || y + kHalf >= image.height) return {};
  Samples samples;
  int best_shift = 0;
  float best = -2;
  for (int shift = -search_px; shift <= search_px; ++shift) {
    if (!inside(static_cast<float>(x + shift))) continue;
    sample_row(image, static_cast<float>(x + shift), y, samples);
    const float correlation = compare(patch, samples).correlation;
    if (correlation > best) {
      best = correlation;
      best_shift = shift;
    }
  }
  // A best shift at the end of the range is no maximum.
  if (best <= 0 || std::abs(best_shift) == search_px) return {};
  return iterate(patch, static_cast<float>(best_shift), static_cast<float>(search_px),
                 [&](float shift, Samples& out) {
                   const float centre = static_cast<float>(x) + shift;
                   if (!inside(centre)) return false;
                   sample_row(image, centre, y, out);
                   return true;
                 });
}

}  // namespace fastloop
