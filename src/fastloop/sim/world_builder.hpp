#pragma once

#include <span>

#include "fastloop/sim/world.hpp"

namespace fastloop::sim {

/// An upright box, turned about the vertical.
struct Block {
  Vector3d centre = Vector3d::Zero();
  Vector3d half = Vector3d::Ones();  ///< half sizes along its own axes
  double yaw = 0;
};

/// Collects surfaces; gives each its own texture and light.
class WorldBuilder {
 public:
  WorldBuilder(std::uint64_t seed, std::span<const Vector3d> path) : random_(seed), path_(path) {}

  Random& random() { return random_; }
  /// Rectangle origin, origin + a, origin + a + b, origin + b, visible from both sides.
  void quad(const Vector3d& origin, const Vector3d& a, const Vector3d& b, double coarsest_m);
  /// Five or six faces; the bottom is left out when it stands on the floor.
  void block(const Block& block, double coarsest_m, bool with_bottom);
  /// Adds the block unless it comes closer than `clear_m` to the path. @return whether it was added
  bool try_block(const Block& block, double coarsest_m, bool with_bottom, double clear_m);
  /// Walls, floor and ceiling of an upright room, seen from inside.
  void shell(const Vector3d& low, const Vector3d& high, double coarsest_m, bool with_ceiling);
  /// Boxes standing on the floor or on each other, hanging from the ceiling and flat on the walls.
  void furnish(const Vector3d& low, const Vector3d& high, int standing, int hanging, int flat,
               double largest_m, double clear_m);
  World finish();

 private:
  void furnish_flat(const Vector3d& low, const Vector3d& high, double largest_m, double clear_m);

  Random random_;
  std::span<const Vector3d> path_;
  World world_;
};

}  // namespace fastloop::sim
