#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/sim/world.hpp"

namespace fastloop::sim {

/// Rays that are traced and shaded together. Fixed-size loops over the lanes become vector instructions.
inline constexpr int kLanes = 16;

struct alignas(64) RayPacket {
  // Direction in the camera frame (unit), and its change to the next pixel right and down.
  float x[kLanes], y[kLanes], z[kLanes];
  float ux[kLanes], uy[kLanes], uz[kLanes];
  float vx[kLanes], vy[kLanes], vz[kLanes];
};

struct alignas(64) PacketHits {
  float distance[kLanes];       ///< along the unit ray, metres
  std::int32_t surface[kLanes];  ///< index, or kSky
};
inline constexpr std::int32_t kSky = -1;

/// Bounding volume hierarchy over the surfaces of a world.
struct Bvh {
  struct Node {
    Eigen::Vector3d low, high;
    std::int32_t first = 0;  ///< leaf: first entry of `order`; else: left child, the right one follows it
    std::int32_t count = 0;  ///< surfaces in a leaf, 0 = inner node
    std::int32_t axis = 0;   ///< of the split
  };
  std::vector<Node> nodes;
  std::vector<std::int32_t> order;
};

Bvh build_bvh(const std::vector<Surface>& surfaces);

/// A world seen from one camera pose: everything relative to the camera centre, in single precision.
class TracedView {
 public:
  /// Vectors of a surface, relative to the camera centre. `world` axes serve tracing, `camera` axes shading.
  struct Plane {
    float n[3], a[3], b[3];                 ///< world axes
    float n_camera[3], a_camera[3], b_camera[3];
    float height;                           ///< normal . (origin - camera)
    float s0, t0;                           ///< surface coordinates of the camera centre
    float length_a, length_b;
  };

  TracedView(const World& world, const Bvh& bvh, const SE3& T_world_camera);

  /// Nearest surface along each ray.
  void trace(const RayPacket& rays, PacketHits& hits) const;
  const Plane& plane(std::int32_t surface) const { return planes_[surface]; }
  /// Height of a camera ray above the horizon: z of its direction in the world.
  const float* up_in_camera() const { return rotation_ + 6; }

 private:
  struct Node {
    float low[3], high[3];
    std::int32_t first, count, axis;
  };
  std::vector<Node> nodes_;
  std::vector<std::int32_t> order_;
  std::vector<Plane> planes_;
  float rotation_[9];  ///< R_world_camera, row major
};

}  // namespace fastloop::sim
