#pragma once

#include <vector>

#include "fastloop/sim/map_worlds.hpp"

/// The way that a simulated map was made on, and the drift along it. Part of simulate_map.
namespace fastloop::sim {

/// Lengths that follow from the options, metres.
struct RouteSizes {
  double step = 0;     ///< between keyframes
  double window = 0;   ///< a point is seen from at most this far before and behind its home
  double shared = 0;   ///< length of a stretch that is walked twice
  double last = 0;     ///< way since the pending loop was entered
  double circuit = 0;  ///< the ring
  std::vector<double> detours;
};
/// @throws InvalidArgument when the keyframes are too few
RouteSizes route_sizes(const MapWorldOptions& options);

/// Road 0 is the ring, a circle; roads 1.. are detours that leave it and come back to it.
/// Positions on the ring may lie outside of [0, circuit): they count turns.
class RoadMap {
 public:
  RoadMap(const RouteSizes& sizes);

  std::size_t num_roads() const { return 1 + detours_.size(); }
  double length(std::size_t road) const;
  double circuit() const { return circuit_; }
  /// Where detour `road` (>= 1) leaves the ring; it comes back `shared` before that.
  double exit_of(std::size_t road) const { return exits_[road - 1]; }

  Vector3d position(std::size_t road, double s) const;
  /// Carrier (x forward, y left, z up) on the middle of the road.
  SE3 T_world_carrier(std::size_t road, double s) const;

 private:
  struct Polyline {
    std::vector<Vector3d> points;
    std::vector<double> length;  ///< [points] way from the first
  };
  Polyline detour_line(double begin, double shared, double radius) const;

  double circuit_, radius_;
  std::vector<Polyline> detours_;
  std::vector<double> exits_;
};

/// A piece of the way: the road from `begin` to `end`, walked when the way is
/// [at, at + end - begin].
struct RoutePiece {
  std::size_t road = 0;
  double begin = 0, end = 0, at = 0;
};

/// A keyframe's place.
struct RouteStop {
  double way = 0;  ///< metres since the start
  std::size_t road = 0;
  double s = 0;  ///< on the road
  SE3 T_world_body, T_map_body;
  Vector3d v_map = Vector3d::Zero();
};

/// One uninterrupted run, which becomes one map.
struct Run {
  std::vector<RoutePiece> pieces;  ///< in the order of the way; they reach a window beyond its ends
  std::vector<RouteStop> stops;
};

/// One run, or two when the options ask for two maps. The stops' poses are true and drifted.
std::vector<Run> make_runs(const MapWorldOptions& options, const RouteSizes& sizes,
                           const RoadMap& roads, const Eigen::Quaterniond& R_carrier_body);

inline constexpr double kSpeed = 1.5;  ///< of the carrier, m / s

}  // namespace fastloop::sim
