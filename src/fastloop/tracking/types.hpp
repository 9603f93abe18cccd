#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/map/keyframe_request.hpp"
#include "fastloop/map/snapshot.hpp"

namespace fastloop::tracking {

enum class State { kInitialising, kTracking, kRecentlyLost, kLost };
const char* to_string(State state);

struct TrackingOptions {
  bool use_imu = false;
  bool localize_only = false;  ///< finds its place in the map at hand and asks for no keyframes
  double imu_noise_factor =
      20;  ///< on the white noise densities of the calibration: vibration, scale errors
  int min_initial_depth_points = 100;  ///< keypoints with depth needed to start a map
  int min_inliers = 30;                ///< landmarks that must agree with a visual pose
  int min_inliers_inertial = 15;       ///< the same with an initialised IMU
  float last_frame_radius_px = 15;     ///< search window around the prediction, constant velocity
  float last_frame_radius_inertial_px = 10;
  std::size_t max_local_keyframes = 40;
  double recently_lost_s = 3;  ///< until a new map is started
  double recently_lost_inertial_s = 5;
  double close_depth_baselines = 40;  ///< depth of trusted stereo points, in stereo baselines
  double keyframe_interval_s = 0.5;   ///< with IMU: at least one keyframe in this time
  double keyframe_interval_before_imu_s = 0.25;
  double min_keyframe_interval_s = 0.1;
  double keyframe_match_ratio =
      0.75;  ///< insert when fewer landmarks than this share of the reference's are seen
  void validate() const;
};

/// A frame after tracking.
struct TrackedFrame {
  FrameId id;
  Nanoseconds stamp_ns = 0;
  std::shared_ptr<const FeatureSet> features;
  std::vector<LandmarkId> landmarks;  ///< [num_keypoints]
  NavState state;
  KeyframeId reference;
  SE3 T_reference_body;
};

/// Outcome of one frame. `reason` says why the state changed, in words for the event log.
struct TrackResult {
  State state = State::kInitialising;
  std::string reason;
  bool has_pose = false;
  SE3 T_world_body;  ///< as known now
  KeyframeId reference;
  SE3 T_reference_body;
  int inliers = 0;
  std::optional<map::KeyframeRequest> keyframe;
};

}  // namespace fastloop::tracking
