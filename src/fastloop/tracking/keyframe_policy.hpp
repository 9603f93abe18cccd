#pragma once

#include "fastloop/tracking/types.hpp"

namespace fastloop::tracking {

/// What the decision to insert a keyframe depends on.
struct KeyframeSituation {
  double seconds_since_keyframe = 0;
  int inliers = 0;              ///< landmarks agreeing with the pose
  int reference_landmarks = 0;  ///< of the reference keyframe, seen by enough keyframes
  int close_tracked = 0;        ///< close keypoints with a landmark
  int close_untracked = 0;      ///< close keypoints with depth but no landmark
  bool mapping_idle = true;
  bool imu_initialized = false;
};

/// Counts close keypoints of a frame.
void count_close_points(const TrackedFrame& frame, float close_depth_m,
                        KeyframeSituation& situation);

/// Whether the frame should become a keyframe.
bool needs_keyframe(const KeyframeSituation& situation, const TrackingOptions& options);

}  // namespace fastloop::tracking
