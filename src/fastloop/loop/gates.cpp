#include "fastloop/loop/gates.hpp"

#include <cmath>

namespace fastloop::loop {
namespace {

/// Rotation as turns about the world's axes: the part about z, and the tilt left without it.
struct Turn {
  double yaw, tilt_x, tilt_y;
};

Turn turn_of(const Eigen::Quaterniond& q) {
  const Eigen::Quaterniond yaw = Eigen::Quaterniond(q.w(), 0, 0, q.z()).normalized();
  const Vector3d rest = so3::log(yaw.conjugate() * q);
  return {so3::log(yaw).z(), rest.x(), rest.y()};
}

class Gates {
 public:
  explicit Gates(CandidateReport& report) : report_(report) {}
  /// Passed when |value| <= threshold.
  bool bound(const char* name, double value, double threshold) {
    const bool passed = std::abs(value) <= threshold;
    report_.gates.push_back({name, value, threshold, passed});
    return passed;
  }

 private:
  CandidateReport& report_;
};

}  // namespace

double path_length_m(const map::Snapshot& snapshot, KeyframeId from, KeyframeId to) {
  double length = 0;
  KeyframeId id = to;
  while (id.valid() && id > from) {
    const KeyframeId previous = snapshot.keyframe(id).previous;
    if (!previous.valid()) break;
    length += (snapshot.T_world_body(id).translation - snapshot.T_world_body(previous).translation)
                  .norm();
    id = previous;
  }
  return length;
}

std::optional<std::string> check_motion(const map::Snapshot& snapshot, const LoopOptions& o,
                                        RegionMatch& match, CandidateReport& report) {
  Gates gates(report);
  const SE3 T_world_now = snapshot.T_world_camera(match.current);
  SE3 T_world_new = match.T_camera_world.inverse();
  const Eigen::Quaterniond turned = T_world_new.rotation * T_world_now.rotation.conjugate();
  if (o.inertial) {
    const Turn turn = turn_of(turned);
    if (!gates.bound("roll rad", turn.tilt_x, o.max_tilt_rad) ||
        !gates.bound("pitch rad", turn.tilt_y, o.max_tilt_rad))
      return "it would tilt the map against gravity";
    if (!match.merge && !gates.bound("yaw rad", turn.yaw, o.max_yaw_rad))
      return "it would turn the map too far";
    T_world_new.rotation = so3::exp({0, 0, turn.yaw}) * T_world_now.rotation;
    match.T_camera_world = T_world_new.inverse();
  }
  if (match.merge || o.max_drift_ratio <= 0) return std::nullopt;
  const double path = path_length_m(snapshot, match.matched, match.current);
  const double metres = (T_world_new.translation - T_world_now.translation).norm();
  const double angle = so3::log(turned).norm();
  if (!gates.bound("drift m", metres, o.max_drift_constant_m + o.max_drift_ratio * path) ||
      !gates.bound("drift rad", angle, o.max_drift_constant_rad + o.max_drift_rad_per_m * path))
    return "odometry cannot have drifted that far; another place that looks the same";
  return std::nullopt;
}

}  // namespace fastloop::loop
