#include "fastloop/sim/texture.hpp"

#include "fastloop/sim/wide_vectors.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "fastloop/sim/random.hpp"

namespace fastloop::sim {
namespace {

constexpr float kLacunarity = 0.46f;     ///< cell size of a layer over that of the coarser one
constexpr float kFinest_m = 0.004f;      ///< no cells smaller than this
constexpr int kMaxLayers = 14;
constexpr float kFadeOut_px = 7.0f;      ///< cells of this many pixels are invisible
constexpr float kFadeIn_px = 16.0f;      ///< and from here on they are drawn in full
constexpr float kGrazing = 0.16f;        ///< share of the long side of a footprint, squared

constexpr float byte(std::uint32_t h, int shift) {
  return static_cast<float>((h >> shift) & 255u) * (1.0f / 255.0f);
}

float ramp(float x) { return std::min(std::max(x, 0.0f), 1.0f); }

struct Layer {
  float cos, sin;      ///< orientation
  float inverse_cell;  ///< 1 / metres
  float opacity;
  std::uint32_t seed;
};

Layer make_layer(const Surface& surface, int k, float cell_m) {
  const std::uint32_t h = mix32(surface.seed + 0x9E3779B9u * static_cast<std::uint32_t>(k + 1));
  // Coarse layers follow the edges of the surface, fine ones lie any way.
  const float half_tan = (byte(h, 0) - 0.5f) * (k < 2 ? 0.06f : 0.8f);  // tangent of half the angle
  Layer layer;
  layer.cos = (1 - half_tan * half_tan) / (1 + half_tan * half_tan);
  layer.sin = 2 * half_tan / (1 + half_tan * half_tan);
  layer.inverse_cell = 1.0f / cell_m;
  layer.opacity = (k < 2 ? 0.92f : 0.80f) - 0.25f * byte(h, 8);
  layer.seed = mix32(h + 0x51ED270Bu);
  return layer;
}

/// Signed size of the shape in a cell at one point: 0 outside, up to 1 (or -1 in the dark half of a check).
struct CellShape {
  float coverage, grey;
};

inline CellShape cell_shape(std::uint32_t h, float rx, float ry, float inv_fx, float inv_fy) {
  const std::uint32_t g = h * 0x9E3779B1u + 0x7F4A7C15u;
  const float ax = 0.13f + 0.33f * byte(h, 0), ay = 0.13f + 0.33f * byte(h, 8);
  const float ox = rx - (0.5f + (0.49f - ax) * (2.0f * byte(h, 16) - 1.0f));
  const float oy = ry - (0.5f + (0.49f - ay) * (2.0f * byte(h, 24) - 1.0f));
  const float dx = std::abs(ox), dy = std::abs(oy);
  const float box = ramp((ax - dx) * inv_fx + 0.5f) * ramp((ay - dy) * inv_fy + 0.5f);
  const float inner =
      ramp((0.6f * ax - dx) * inv_fx + 0.5f) * ramp((0.6f * ay - dy) * inv_fy + 0.5f);
  const float radius = std::min(ax, ay);
  const float disc = ramp((radius - std::sqrt(ox * ox + oy * oy)) * std::min(inv_fx, inv_fy) + 0.5f);
  const float flip_x = 2.0f * ramp(ox * inv_fx + 0.5f) - 1.0f;
  const float flip_y = 2.0f * ramp(oy * inv_fy + 0.5f) - 1.0f;

  const std::uint32_t kind = (g >> 24) & 15u;  // 0-6 box, 7-9 disc, 10-12 frame, 13-15 check
  const float round = (kind >= 7u) & (kind < 10u) ? 1.0f : 0.0f;
  const float hollow = (kind >= 10u) & (kind < 13u) ? 1.0f : 0.0f;
  const float check = kind >= 13u ? 1.0f : 0.0f;
  const float present = ((g >> 16) & 255u) < 165u ? 1.0f : 0.0f;
  CellShape shape;
  shape.coverage = present * (box + round * (disc - box) - hollow * inner);
  const float tone = 2.0f * byte(g, 8) - 1.0f;
  const float sign = 1.0f + check * (flip_x * flip_y - 1.0f);
  // Square-root like spread: few greys near the middle, where shapes would not show.
  shape.grey = 125.0f + 105.0f * sign * tone * (1.35f - 0.35f * std::abs(tone));
  return shape;
}

void draw_layer(const Layer& layer, const TexelBlock& p, const float* footprint_m, float* value) {
  for (int l = 0; l < kTexels; ++l) {
    const float c = layer.cos * layer.inverse_cell, s = layer.sin * layer.inverse_cell;
    const float x = c * p.s[l] + s * p.t[l], y = c * p.t[l] - s * p.s[l];
    const float xu = c * p.su[l] + s * p.tu[l], xv = c * p.sv[l] + s * p.tv[l];
    const float yu = c * p.tu[l] - s * p.su[l], yv = c * p.tv[l] - s * p.sv[l];
    const float inv_fx = 1.0f / (std::sqrt(xu * xu + xv * xv) + 1e-7f);
    const float inv_fy = 1.0f / (std::sqrt(yu * yu + yv * yv) + 1e-7f);
    std::int32_t ix = static_cast<std::int32_t>(x), iy = static_cast<std::int32_t>(y);
    ix -= x < static_cast<float>(ix) ? 1 : 0;
    iy -= y < static_cast<float>(iy) ? 1 : 0;
    const std::uint32_t h = mix32(static_cast<std::uint32_t>(ix) * 0x8DA6B343u ^
                                  static_cast<std::uint32_t>(iy) * 0xD8163841u ^ layer.seed);
    const CellShape shape = cell_shape(h, x - static_cast<float>(ix), y - static_cast<float>(iy),
                                       inv_fx, inv_fy);
    const float cell_px = 1.0f / (layer.inverse_cell * footprint_m[l]);
    const float fade = ramp((cell_px - kFadeOut_px) * (1.0f / (kFadeIn_px - kFadeOut_px)));
    value[l] += fade * layer.opacity * shape.coverage * (shape.grey - value[l]);
  }
}

}  // namespace

FASTLOOP_WIDE void shade_texels(const Surface& surface, const TexelBlock& p, float* brightness) {
  alignas(32) float footprint_m[kTexels], value[kTexels];
  float smallest = 1e9f;
  for (int l = 0; l < kTexels; ++l) {
    const float u = p.su[l] * p.su[l] + p.tu[l] * p.tu[l], v = p.sv[l] * p.sv[l] + p.tv[l] * p.tv[l];
    // On surfaces seen at a grazing angle the short side of the footprint counts too: the shapes are filtered
    // along each side separately, so that only cells crossed by the long side have to go.
    const float longest = std::max(u, v), cross = std::abs(p.su[l] * p.tv[l] - p.sv[l] * p.tu[l]);
    footprint_m[l] = std::min(std::sqrt(std::max(cross, kGrazing * longest)) + 1e-7f, 1e6f);
    value[l] = surface.base_grey;
  }
  for (int l = 0; l < kTexels; ++l) smallest = std::min(smallest, footprint_m[l]);
  float cell_m = surface.coarsest_m;
  for (int k = 0; k < kMaxLayers; ++k, cell_m *= kLacunarity) {
    if (cell_m < kFinest_m || cell_m < kFadeOut_px * smallest) break;
    draw_layer(make_layer(surface, k, cell_m), p, footprint_m, value);
  }
  const auto& light = surface.light;
  const float inv_a = 1.0f / static_cast<float>(surface.length_a);
  const float inv_b = 1.0f / static_cast<float>(surface.length_b);
  for (int l = 0; l < kTexels; ++l) {
    const float a = ramp(p.s[l] * inv_a), b = ramp(p.t[l] * inv_b);
    const float near = light[0] + a * (light[1] - light[0]);
    const float far = light[2] + a * (light[3] - light[2]);
    brightness[l] = value[l] * (near + b * (far - near));
  }
}

}  // namespace fastloop::sim
