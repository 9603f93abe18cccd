#include "fastloop/sim/renderer.hpp"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <cmath>

#include "fastloop/sim/texture.hpp"

namespace fastloop::sim {
namespace {

constexpr int kRowsPerTask = 16;
constexpr float kFisheyeRim_rad = 1.70f, kFisheyeRimWidth_rad = 0.22f;

/// Light that reaches a pixel: falls towards the corners, to nothing outside the image circle of a fisheye.
float vignette(const Camera& camera, const Vector3d& ray, int u, int v) {
  if (camera.model == CameraModel::kKannalaBrandt) {
    const double theta = std::atan2(std::hypot(ray.x(), ray.y()), ray.z());
    const double e = std::clamp((kFisheyeRim_rad - theta) / kFisheyeRimWidth_rad, 0.0, 1.0);
    return static_cast<float>((1 - 0.45 * theta * theta / 2.4) * e * e * (3 - 2 * e));
  }
  const double x = (u - camera.cx) / (0.5 * camera.width), y = (v - camera.cy) / (0.5 * camera.width);
  return static_cast<float>(1 - 0.2 * (x * x + y * y));
}

template <class Body>
void for_row_bands(int height, const Body& body) {
  const int bands = (height + kRowsPerTask - 1) / kRowsPerTask;
  tbb::parallel_for(tbb::blocked_range<int>(0, bands, 1), [&](const tbb::blocked_range<int>& r) {
    for (int b = r.begin(); b < r.end(); ++b)
      body(b * kRowsPerTask, std::min(height, (b + 1) * kRowsPerTask));
  });
}

float dot3(const float* a, float x, float y, float z) { return a[0] * x + a[1] * y + a[2] * z; }

/// Surface coordinates and their derivatives where rays meet the plane of a surface.
void intersect_plane(const TracedView::Plane& p, const RayPacket& r, int first, TexelBlock& block) {
  for (int i = 0; i < kTexels; ++i) {
    const int l = first + i;
    const float nd = dot3(p.n_camera, r.x[l], r.y[l], r.z[l]);
    const float ad = dot3(p.a_camera, r.x[l], r.y[l], r.z[l]);
    const float bd = dot3(p.b_camera, r.x[l], r.y[l], r.z[l]);
    const float nu = dot3(p.n_camera, r.ux[l], r.uy[l], r.uz[l]);
    const float nv = dot3(p.n_camera, r.vx[l], r.vy[l], r.vz[l]);
    const float au = dot3(p.a_camera, r.ux[l], r.uy[l], r.uz[l]);
    const float av = dot3(p.a_camera, r.vx[l], r.vy[l], r.vz[l]);
    const float bu = dot3(p.b_camera, r.ux[l], r.uy[l], r.uz[l]);
    const float bv = dot3(p.b_camera, r.vx[l], r.vy[l], r.vz[l]);
    const float distance = p.height / nd, scale = distance / nd;
    block.s[i] = p.s0 + distance * ad;
    block.t[i] = p.t0 + distance * bd;
    block.su[i] = scale * (au * nd - ad * nu);
    block.sv[i] = scale * (av * nd - ad * nv);
    block.tu[i] = scale * (bu * nd - bd * nu);
    block.tv[i] = scale * (bv * nd - bd * nv);
  }
}

/// Adds sensor noise and quantises one row. Sum of four bytes: close to normal, and cheap.
void develop_row(const float* brightness, const float* falloff, int width, const Exposure& exposure,
                 std::uint32_t row_seed, std::uint8_t* out) {
  for (int x = 0; x < width; ++x) {
    const float value = exposure.gain * falloff[x] * brightness[x];
    const std::uint32_t h = mix32(row_seed + 0x9E3779B9u * static_cast<std::uint32_t>(x));
    const auto sum = static_cast<std::int32_t>((h & 255u) + ((h >> 8) & 255u) + ((h >> 16) & 255u) +
                                               (h >> 24));
    const float normal = (static_cast<float>(sum) - 510.0f) * (1.0f / 147.8f);
    const float sigma = std::sqrt(exposure.noise_offset + exposure.noise_slope * value);
    const float noisy = value + sigma * normal + 0.5f;
    out[x] = static_cast<std::uint8_t>(static_cast<std::int32_t>(std::min(std::max(noisy, 0.0f), 255.0f)));
  }
}

double unit(std::uint64_t h) { return static_cast<double>(h >> 11) * 0x1.0p-53; }

}  // namespace

RayTable::RayTable(const Camera& camera)
    : width_(camera.width), height_(camera.height),
      stride_((camera.width + kLanes) / kLanes * kLanes + kLanes) {
  const std::size_t n = static_cast<std::size_t>(height_ + kPacketRows) * stride_;
  x_.resize(n);
  y_.resize(n);
  z_.resize(n);
  falloff_.resize(static_cast<std::size_t>(width_) * height_);
  for_row_bands(height_ + kPacketRows, [&](int begin, int end) {
    for (int v = begin; v < end; ++v) {
      for (int u = 0; u < stride_; ++u) {
        const Vector3d ray = camera.unproject(Eigen::Vector2d(std::min(u, width_), v));
        x_[index(u, v)] = static_cast<float>(ray.x());
        y_[index(u, v)] = static_cast<float>(ray.y());
        z_[index(u, v)] = static_cast<float>(ray.z());
        if (u < width_ && v < height_)
          falloff_[static_cast<std::size_t>(v) * width_ + u] = vignette(camera, ray, u, v);
      }
    }
  });
}

void RayTable::load(int x, int y, RayPacket& r) const {
  for (int l = 0; l < kLanes; ++l) {
    const std::size_t here = index(x + lane_column(l), y + lane_row(l));
    r.x[l] = x_[here];
    r.y[l] = y_[here];
    r.z[l] = z_[here];
    r.ux[l] = x_[here + 1] - r.x[l];
    r.uy[l] = y_[here + 1] - r.y[l];
    r.uz[l] = z_[here + 1] - r.z[l];
    r.vx[l] = x_[here + stride_] - r.x[l];
    r.vy[l] = y_[here + stride_] - r.y[l];
    r.vz[l] = z_[here + stride_] - r.z[l];
  }
}

void RayTable::load_lane(int x, int y, float offset_x, float offset_y, int l, RayPacket& r) const {
  const std::size_t here = index(x, y), below = here + stride_;
  r.ux[l] = x_[here + 1] - x_[here];
  r.uy[l] = y_[here + 1] - y_[here];
  r.uz[l] = z_[here + 1] - z_[here];
  r.vx[l] = x_[below] - x_[here];
  r.vy[l] = y_[below] - y_[here];
  r.vz[l] = z_[below] - z_[here];
  r.x[l] = x_[here] + offset_x * r.ux[l] + offset_y * r.vx[l];
  r.y[l] = y_[here] + offset_x * r.uy[l] + offset_y * r.vy[l];
  r.z[l] = z_[here] + offset_x * r.uz[l] + offset_y * r.vz[l];
}

/// Image being drawn, before exposure.
struct Renderer::Canvas {
  int width, height;
  std::vector<float> brightness, distance;  ///< [height * width]
  std::vector<std::int32_t> surface;        ///< [height * width]

  Canvas(int w, int h)
      : width(w), height(h), brightness(static_cast<std::size_t>(w) * h), distance(brightness.size()),
        surface(brightness.size()) {}
};

Renderer::Renderer(World world) : world_(std::move(world)), bvh_(build_bvh(world_.surfaces)) {}

void Renderer::shade(const TracedView& view, const RayPacket& rays, const PacketHits& hits,
                     float* brightness) const {
  for (int first = 0; first < kLanes; first += kTexels) {
    unsigned open = (1u << kTexels) - 1;  // lanes not shaded yet
    while (open) {
      const std::int32_t index = hits.surface[first + __builtin_ctz(open)];
      alignas(32) float value[kTexels];
      if (index == kSky) {
        const float* up = view.up_in_camera();
        for (int i = 0; i < kTexels; ++i) {
          const int l = first + i;
          value[i] = 205.0f - 45.0f * dot3(up, rays.x[l], rays.y[l], rays.z[l]);
        }
      } else {
        TexelBlock block;
        intersect_plane(view.plane(index), rays, first, block);
        shade_texels(world_.surfaces[index], block, value);
      }
      for (int i = 0; i < kTexels; ++i) {
        if (hits.surface[first + i] != index) continue;
        brightness[first + i] = value[i];
        open &= ~(1u << i);
      }
    }
  }
}

void Renderer::draw_rows(const TracedView& view, const RayTable& table, int begin, int end,
                         Canvas& canvas) const {
  RayPacket rays;
  PacketHits hits;
  alignas(64) float value[kLanes];
  for (int y = begin; y < end; y += kPacketRows) {
    for (int x = 0; x < canvas.width; x += kPacketColumns) {
      table.load(x, y, rays);
      view.trace(rays, hits);
      shade(view, rays, hits, value);
      for (int l = 0; l < kLanes; ++l) {
        const int u = x + lane_column(l), v = y + lane_row(l);
        if (u >= canvas.width || v >= end) continue;
        const std::size_t at = static_cast<std::size_t>(v) * canvas.width + u;
        canvas.brightness[at] = value[l];
        canvas.distance[at] = hits.distance[l];
        canvas.surface[at] = hits.surface[l];
      }
    }
  }
}

void Renderer::smooth_edges(const TracedView& view, const RayTable& table, int begin, int end,
                            Canvas& canvas) const {
  constexpr int kSamples = 4, kPixels = kLanes / kSamples;
  constexpr float kOffsetX[kSamples] = {-0.375f, -0.125f, 0.125f, 0.375f};
  constexpr float kOffsetY[kSamples] = {-0.125f, 0.375f, -0.375f, 0.125f};
  const int w = canvas.width, h = canvas.height;
  RayPacket rays;
  PacketHits hits;
  alignas(64) float value[kLanes];
  std::size_t pending[kPixels];
  int count = 0;
  const auto flush = [&] {
    if (count == 0) return;
    for (int i = count; i < kPixels; ++i)  // fill the unused lanes
      for (int s = 0; s < kSamples; ++s)
        table.load_lane(static_cast<int>(pending[0] % w), static_cast<int>(pending[0] / w), 0, 0,
                        i * kSamples + s, rays);
    view.trace(rays, hits);
    shade(view, rays, hits, value);
    for (int i = 0; i < count; ++i) {
      float sum = 0;
      for (int s = 0; s < kSamples; ++s) sum += value[i * kSamples + s];
      canvas.brightness[pending[i]] = sum / kSamples;
    }
    count = 0;
  };
  for (int y = begin; y < end; ++y) {
    for (int x = 0; x < w; ++x) {
      const std::size_t at = static_cast<std::size_t>(y) * w + x;
      const std::int32_t s = canvas.surface[at];
      const bool edge = (x > 0 && canvas.surface[at - 1] != s) || (x + 1 < w && canvas.surface[at + 1] != s) ||
                        (y > 0 && canvas.surface[at - w] != s) || (y + 1 < h && canvas.surface[at + w] != s);
      if (!edge) continue;
      for (int k = 0; k < kSamples; ++k)
        table.load_lane(x, y, kOffsetX[k], kOffsetY[k], count * kSamples + k, rays);
      pending[count++] = at;
      if (count == kPixels) flush();
    }
  }
  flush();
}

namespace {

/// Depth camera: quadratic noise, limited range, holes at grazing angles and beside depth steps.
struct DepthSensor {
  const TracedView& view;
  const RayTable& table;
  const DepthNoise& noise;
  int width, height;
  const float* distance;
  const std::int32_t* surface;

  float exact(int x, int y) const {
    return distance[static_cast<std::size_t>(y) * width + x] * table.ray_z(x, y);
  }
  bool hole(int x, int y, float z, std::uint64_t h) const {
    const std::int32_t index = surface[static_cast<std::size_t>(y) * width + x];
    if (index == kSky || !(z >= noise.min_depth_m && z <= noise.max_depth_m)) return true;
    const TracedView::Plane& p = view.plane(index);
    RayPacket r;
    table.load_lane(x, y, 0, 0, 0, r);
    const float cosine = std::abs(dot3(p.n_camera, r.x[0], r.y[0], r.z[0]));
    if (unit(mix64(h ^ 0xA11)) > (cosine - 0.08f) / 0.12f) return true;
    for (int step = -2; step <= 2; ++step) {  // shadow of the projector beside a step in depth
      const int nx = x + step;
      if (nx < 0 || nx >= width) continue;
      if (std::abs(exact(nx, y) - z) > 0.06f * z && unit(mix64(h ^ 0xB22)) < 0.7) return true;
    }
    const int border = std::min(std::min(x, width - 1 - x), std::min(y, height - 1 - y));
    return border < 8 && unit(mix64(h ^ 0xC33)) > (border + 1) / 9.0;
  }
  float measure(int x, int y) const {
    const float z = exact(x, y);
    if (!noise.enabled) return surface[static_cast<std::size_t>(y) * width + x] == kSky ? 0 : z;
    const std::uint64_t h = mix64(noise.seed ^ (static_cast<std::uint64_t>(y) << 32 | static_cast<unsigned>(x)));
    if (hole(x, y, z, h)) return 0;
    const double u = 1.0 - unit(mix64(h ^ 1)), angle = 2 * M_PI * unit(mix64(h ^ 2));
    const double sigma = 0.0012 + 0.0019 * (z - 0.4) * (z - 0.4);
    const double noisy = z + sigma * std::sqrt(-2 * std::log(u)) * std::cos(angle);
    return static_cast<float>(std::round(noisy * noise.units_per_metre) / noise.units_per_metre);
  }
};

}  // namespace

ImageU8 Renderer::render(const RayTable& table, const SE3& T_world_camera, const Exposure& exposure,
                         ImageF32* depth, const DepthNoise& depth_noise) const {
  const int w = table.width(), h = table.height();
  const TracedView view(world_, bvh_, T_world_camera);
  Canvas canvas(w, h);
  for_row_bands(h, [&](int begin, int end) { draw_rows(view, table, begin, end, canvas); });
  for_row_bands(h, [&](int begin, int end) { smooth_edges(view, table, begin, end, canvas); });
  ImageU8 image(w, h);
  if (depth) *depth = ImageF32(w, h);
  for_row_bands(h, [&](int begin, int end) {
    std::vector<float> falloff(w);
    for (int y = begin; y < end; ++y) {
      for (int x = 0; x < w; ++x) falloff[x] = table.falloff(x, y);
      const auto row_seed = static_cast<std::uint32_t>(mix64(exposure.noise_seed * 0x10001 + y));
      develop_row(canvas.brightness.data() + static_cast<std::size_t>(y) * w, falloff.data(), w, exposure,
                  row_seed, image.row(y));
      if (!depth) continue;
      const DepthSensor sensor{view, table, depth_noise, w, h, canvas.distance.data(), canvas.surface.data()};
      for (int x = 0; x < w; ++x) depth->at(x, y) = sensor.measure(x, y);
    }
  });
  return image;
}

}  // namespace fastloop::sim
