#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/sim/motion.hpp"
#include "fastloop/sim/random.hpp"

namespace fastloop::sim {

/// A textured rectangle: origin + s * axis_a + t * axis_b, 0 <= s <= length_a, 0 <= t <= length_b.
struct Surface {
  Vector3d origin = Vector3d::Zero();
  Vector3d axis_a = Vector3d::UnitX(), axis_b = Vector3d::UnitY();  ///< orthogonal unit vectors
  double length_a = 1, length_b = 1;                                ///< metres
  std::uint32_t seed = 0;      ///< of its texture
  float base_grey = 120;       ///< ground colour
  float coarsest_m = 1;        ///< size of the largest texture cells
  std::array<float, 4> light{1, 1, 1, 1};  ///< brightness at (0,0), (a,0), (0,b), (a,b)

  Vector3d normal() const { return axis_a.cross(axis_b); }
};

/// What is rendered: opaque rectangles, and a sky where a ray meets none.
struct World {
  std::vector<Surface> surfaces;
  Vector3d low = Vector3d::Zero(), high = Vector3d::Zero();  ///< bounds
};

/// The world of a kind: its walls, pillars and clutter, kept clear of the motion.
/// @param path  positions the cameras will take, about every 0.1 m
World make_world(WorldKind kind, std::uint64_t seed, std::span<const Vector3d> path);

/// A world around any motion: walls about its bounding box, clutter along the way.
World make_world_around(std::uint64_t seed, std::span<const Vector3d> path);

/// Positions along a motion, every `step_s` seconds.
std::vector<Vector3d> sample_path(const Trajectory& trajectory, double step_s = 0.1);

/// Shortest distance from the path to any surface, metres.
double clearance(const World& world, std::span<const Vector3d> path);

}  // namespace fastloop::sim
