#include "fastloop/tracking/types.hpp"

#include "fastloop/core/error.hpp"

namespace fastloop::tracking {

const char* to_string(State state) {
  switch (state) {
    case State::kInitialising:
      return "initialising";
    case State::kTracking:
      return "tracking";
    case State::kRecentlyLost:
      return "recently lost";
    case State::kLost:
      return "lost";
  }
  return "unknown";
}

void TrackingOptions::validate() const {
  const auto require = [](bool ok, const char* what) {
    if (!ok) throw InvalidArgument(std::string("TrackingOptions::") + what);
  };
  require(imu_noise_factor > 0, "imu_noise_factor must be positive");
  require(min_initial_depth_points >= 3, "min_initial_depth_points must be at least 3");
  require(min_inliers >= 6 && min_inliers_inertial >= 6, "min_inliers must be at least 6");
  require(last_frame_radius_px > 0 && last_frame_radius_inertial_px > 0,
          "search radii must be positive");
  require(max_local_keyframes >= 2, "max_local_keyframes must be at least 2");
  require(recently_lost_s >= 0 && recently_lost_inertial_s >= 0,
          "recently_lost times must not be negative");
  require(close_depth_baselines > 0, "close_depth_baselines must be positive");
  require(keyframe_match_ratio > 0 && keyframe_match_ratio <= 1,
          "keyframe_match_ratio must be in (0, 1]");
}

}  // namespace fastloop::tracking
