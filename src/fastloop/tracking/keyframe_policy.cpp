#include "fastloop/tracking/keyframe_policy.hpp"

namespace fastloop::tracking {
namespace {
constexpr int kEnoughCloseTracked = 100;
constexpr int kManyCloseUntracked = 70;
constexpr double kWeakRatio = 0.4;  ///< so few landmarks left that waiting for mapping is no option
constexpr double kForcedIntervalS = 1.0;
}  // namespace

void count_close_points(const TrackedFrame& frame, float close_depth_m, KeyframeSituation& s) {
  s.close_tracked = s.close_untracked = 0;
  const FeatureSet& f = *frame.features;
  for (std::size_t i = 0; i < f.size(); ++i) {
    if (!f.has_depth(i) || f.depth_m[i] > close_depth_m) continue;
    ++(frame.landmarks[i].valid() ? s.close_tracked : s.close_untracked);
  }
}

bool needs_keyframe(const KeyframeSituation& s, const TrackingOptions& options) {
  if (s.seconds_since_keyframe < options.min_keyframe_interval_s) return false;
  const double interval =
      s.imu_initialized ? options.keyframe_interval_s : options.keyframe_interval_before_imu_s;
  if (options.use_imu && s.seconds_since_keyframe >= interval) return true;

  const bool close_points_missing =
      s.close_tracked < kEnoughCloseTracked && s.close_untracked > kManyCloseUntracked;
  const bool weak = s.inliers < kWeakRatio * s.reference_landmarks;
  const bool fewer_landmarks = s.inliers < options.keyframe_match_ratio * s.reference_landmarks;
  const bool long_ago = s.seconds_since_keyframe >= kForcedIntervalS;
  if (!(fewer_landmarks || close_points_missing)) return false;
  return s.mapping_idle || weak || close_points_missing || long_ago;
}

}  // namespace fastloop::tracking
