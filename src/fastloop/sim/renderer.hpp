#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/geometry/camera.hpp"
#include "fastloop/sensor/image.hpp"
#include "fastloop/sim/ray_tracer.hpp"

namespace fastloop::sim {

/// A packet covers 8x2 pixels, two blocks of 4x2: neighbours see the same surfaces.
inline constexpr int kPacketColumns = 8, kPacketRows = 2;
constexpr int lane_column(int lane) { return lane / 8 * 4 + lane % 4; }
constexpr int lane_row(int lane) { return lane / 4 % 2; }

/// Ray of every pixel of a camera, computed once.
class RayTable {
 public:
  explicit RayTable(const Camera& camera);

  int width() const { return width_; }
  int height() const { return height_; }
  /// Rays of the 8x2 pixels from (x, y) on; lane_column and lane_row say which lane is which.
  void load(int x, int y, RayPacket& rays) const;
  /// Ray of one point of a pixel, by offsets in pixels, into one lane.
  void load_lane(int x, int y, float offset_x, float offset_y, int lane, RayPacket& rays) const;
  float falloff(int x, int y) const { return falloff_[static_cast<std::size_t>(y) * width_ + x]; }
  /// z of the unit ray: depth = z * distance.
  float ray_z(int x, int y) const { return z_[index(x, y)]; }

 private:
  std::size_t index(int x, int y) const { return static_cast<std::size_t>(y) * stride_ + x; }

  int width_, height_, stride_;
  std::vector<float> x_, y_, z_;   ///< [(height + 2) * stride]
  std::vector<float> falloff_;     ///< [height * width] vignetting
};

/// What differs from frame to frame in the way a camera takes its image.
struct Exposure {
  float gain = 1;
  float noise_offset = 1.6f, noise_slope = 0.012f;  ///< variance = offset + slope * value; 0, 0 = no noise
  std::uint64_t noise_seed = 0;
};

struct DepthNoise {
  bool enabled = true;
  float max_depth_m = 8, min_depth_m = 0.35f;
  float units_per_metre = 5000;  ///< values are rounded to this
  std::uint64_t seed = 0;
};

/// Renders images of a world. Thread-safe; the rows of an image are oneTBB tasks, and the result does not
/// depend on the number of threads.
class Renderer {
 public:
  explicit Renderer(World world);

  const World& world() const { return world_; }
  ImageU8 render(const RayTable& table, const SE3& T_world_camera, const Exposure& exposure,
                 ImageF32* depth = nullptr, const DepthNoise& depth_noise = {}) const;

 private:
  struct Canvas;
  void shade(const TracedView& view, const RayPacket& rays, const PacketHits& hits,
             float* brightness) const;
  void draw_rows(const TracedView& view, const RayTable& table, int begin, int end,
                 Canvas& canvas) const;
  void smooth_edges(const TracedView& view, const RayTable& table, int begin, int end,
                    Canvas& canvas) const;

  World world_;
  Bvh bvh_;
};

}  // namespace fastloop::sim
