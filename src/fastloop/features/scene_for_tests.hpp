#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "fastloop/geometry/camera.hpp"
#include "fastloop/geometry/se3.hpp"
#include "fastloop/sensor/image.hpp"

/// Synthetic pictures for tests and benchmarks of this room.
namespace fastloop::synthetic_scene {

/// Random turned rectangles of all sizes, edges one pixel soft: corners on every pyramid level.
inline ImageU8 textured_image(int width, int height, unsigned seed) {
  std::mt19937 rng(seed);
  const auto uniform = [&](float low, float high) {
    return low + (high - low) * static_cast<float>(rng() >> 8) / 16777216.0f;
  };
  std::vector<float> grey(static_cast<std::size_t>(width) * height, 128.f);
  for (int k = 0; k < width * height / 250; ++k) {
    const float size = std::pow(2.0f, uniform(1, 5.5f)), aspect = uniform(0.4f, 1),
                turn = uniform(0, 1.57f);
    const float cx = uniform(0, static_cast<float>(width)),
                cy = uniform(0, static_cast<float>(height));
    const float value = uniform(0, 255), c = std::cos(turn), s = std::sin(turn);
    const int reach = static_cast<int>(1.5f * size) + 2;
    for (int y = std::max(0, static_cast<int>(cy) - reach);
         y < std::min(height, static_cast<int>(cy) + reach); ++y)
      for (int x = std::max(0, static_cast<int>(cx) - reach);
           x < std::min(width, static_cast<int>(cx) + reach); ++x) {
        const float dx = static_cast<float>(x) - cx, dy = static_cast<float>(y) - cy;
        const float outside =
            std::max(std::abs(dx * c + dy * s) - size, std::abs(dy * c - dx * s) - aspect * size);
        const float cover = std::clamp(0.5f - 0.7f * outside, 0.0f, 1.0f);
        float& g = grey[static_cast<std::size_t>(y) * width + x];
        g += cover * (value - g);
      }
  }
  ImageU8 image(width, height);
  for (std::size_t i = 0; i < grey.size(); ++i)
    image.pixels[i] = static_cast<std::uint8_t>(std::lround(grey[i]));
  return image;
}

/// A textured plane through `origin`, spanned by the orthonormal `right` and `down`, seen by any
/// camera.
struct TexturedPlane {
  Vector3d origin, right, down;  ///< world; the texture's centre lies at the origin
  double texels_per_metre = 200;
  ImageU8 texture;

  /// Distance along a ray, negative when it misses.
  double hit(const Vector3d& from, const Vector3d& ray) const {
    const Vector3d normal = right.cross(down);
    const double slope = ray.dot(normal);
    return std::abs(slope) < 1e-9 ? -1 : (origin - from).dot(normal) / slope;
  }

  /// Grey value at a world point of the plane; black outside the texture.
  double grey(const Vector3d& p) const {
    const double u = (p - origin).dot(right) * texels_per_metre + 0.5 * texture.width;
    const double v = (p - origin).dot(down) * texels_per_metre + 0.5 * texture.height;
    if (!(u >= 0 && v >= 0 && u < texture.width - 1 && v < texture.height - 1)) return 0;
    const int x = static_cast<int>(u), y = static_cast<int>(v);
    const double a = u - x, b = v - y;
    return (1 - b) * ((1 - a) * texture.at(x, y) + a * texture.at(x + 1, y)) +
           b * ((1 - a) * texture.at(x, y + 1) + a * texture.at(x + 1, y + 1));
  }

  /// Image of the plane; `depth`, if given, receives z in the camera frame (0: none).
  ImageU8 render(const Camera& camera, const SE3& T_world_camera, ImageF32* depth = nullptr) const {
    ImageU8 image(camera.width, camera.height);
    if (depth) *depth = ImageF32(camera.width, camera.height);
    for (int y = 0; y < camera.height; ++y)
      for (int x = 0; x < camera.width; ++x) {
        const Vector3d ray_camera = camera.unproject({double(x), double(y)});
        const Vector3d ray = T_world_camera.rotation * ray_camera;
        const double t = hit(T_world_camera.translation, ray);
        if (!(t > 0)) continue;
        image.at(x, y) =
            static_cast<std::uint8_t>(std::lround(grey(T_world_camera.translation + t * ray)));
        if (depth) depth->at(x, y) = static_cast<float>(t * ray_camera.z());
      }
    return image;
  }
};

}  // namespace fastloop::synthetic_scene
