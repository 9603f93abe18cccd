#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "fastloop/sim/trajectory.hpp"

namespace fastloop::sim {

enum class WorldKind { kRoom, kHall, kCorridor, kCampus, kRing, kCloister };

/// @throws InvalidArgument on an unknown name; names are "room", "hall", "corridor", "campus", "ring", "cloister"
WorldKind parse_world_kind(const std::string& name);
std::string to_string(WorldKind kind);
/// Length of the usual sequence, seconds.
double default_seconds(WorldKind kind);

/// Closed path on the floor plan: a polygon with rounded corners, parametrised by arc length.
class FloorPath {
 public:
  FloorPath(const std::vector<Eigen::Vector2d>& corners, double corner_radius_m);

  double length() const { return length_; }
  /// Smoothed over +-smooth_m, so that curvature has no steps.
  Eigen::Vector2d position(double s_m, double smooth_m) const;

 private:
  Eigen::Vector2d raw(double s_m) const;

  std::vector<Eigen::Vector2d> points_;  ///< dense polyline, closed
  std::vector<double> s_;                ///< arc length at points_
  double length_ = 0;
};

/// Floor plan walked in a world. The corridor is the rectangle `corridor_corners`, counter-clockwise.
FloorPath floor_path(WorldKind kind);
std::vector<Eigen::Vector2d> corridor_corners();
/// Ring and cloister: a ring of bays, walked along its middle. Those of the cloister look the same.
inline constexpr int kRingBays = 16;
inline constexpr double kRingRadius = 10;
/// Side of a street block of the campus, centre line to centre line, metres.
inline constexpr double kCampusPitch = 72;

/// Motion of a hand-held (or flying) device through a world: at rest for half a second, then laps of the
/// floor path with sway, changing height and looking around. Starts at time 0.
/// @param carrier_from_body  mounting, see rig.hpp
Trajectory make_motion(WorldKind kind, double seconds, std::uint64_t seed,
                       const Eigen::Quaterniond& carrier_from_body);

}  // namespace fastloop::sim
