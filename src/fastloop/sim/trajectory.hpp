#pragma once

#include <span>
#include <vector>

#include "fastloop/geometry/se3.hpp"

namespace fastloop::sim {

/// Smooth motion of the body: uniform quintic B-spline of positions and (cumulative form) of rotations.
///
/// Positions have four continuous derivatives, so velocity, acceleration and angular velocity are exact
/// derivatives of the pose. Times are seconds; outside [begin_s, end_s] the nearest end is used.
class Trajectory {
 public:
  /// @param control  [n >= 6] control poses; number j belongs to the time begin_s + (j - 2) * knot_s
  Trajectory(double begin_s, double knot_s, std::vector<SE3> control);

  /// Least-squares fit to recorded poses. @param times_s increasing
  /// @throws InvalidArgument on fewer than 2 poses or unordered times
  static Trajectory fit(std::span<const double> times_s, std::span<const SE3> T_world_body,
                        double knot_s);

  double begin_s() const { return begin_s_; }
  double end_s() const;

  SE3 pose(double t_s) const;                   ///< T_world_body
  Vector3d velocity(double t_s) const;          ///< world, m / s
  Vector3d acceleration(double t_s) const;      ///< world, m / s^2
  Vector3d angular_velocity(double t_s) const;  ///< body, rad / s

 private:
  struct Segment {
    std::size_t first;  ///< control pose
    double u;           ///< [0, 1]
  };
  Segment segment(double t_s) const;
  Vector3d blend(double t_s, int derivative) const;

  double begin_s_, knot_s_;
  std::vector<SE3> control_;
};

}  // namespace fastloop::sim
