#include "fastloop/tracking/tracker.hpp"

/// What the tracker does where it does not know where it is.
namespace fastloop::tracking {

/// First pose in a map that is there already.
TrackResult Tracker::localise() {
  TrackResult result;
  std::optional<Relocation> found;
  for (const map::MapInfo& info : snapshot_->maps()) {
    if (info.num_keyframes == 0) continue;
    map_ = info.id;
    found = relocalizer_.relocalise(*snapshot_, *frame_.features, map_, KeyframeId{},
                                    options_.min_inliers);
    if (found) break;
  }
  result.state = state_ = found ? State::kTracking : State::kInitialising;
  if (!found) {
    result.reason = "not found in the map yet";
    return result;
  }
  frame_.state.T_world_body = found->T_world_body;
  frame_.landmarks = std::move(found->landmarks);
  frame_.reference = found->keyframe;
  frame_.T_reference_body =
      snapshot_->T_world_body(found->keyframe).inverse() * found->T_world_body;
  inliers_ = found->inliers;
  motion_s_ = 0;
  pose_version_ = snapshot_->pose_version();
  last_ = frame_;
  result.reason = "found in the map with " + std::to_string(inliers_) + " landmarks";
  result.inliers = inliers_;
  result.has_pose = true;
  result.T_world_body = found->T_world_body;
  result.reference = frame_.reference;
  result.T_reference_body = frame_.T_reference_body;
  return result;
}

bool Tracker::relocalise() {
  const int needed = imu_ready() ? options_.min_inliers_inertial : options_.min_inliers;
  auto found =
      relocalizer_.relocalise(*snapshot_, *frame_.features, map_, last_->reference, needed);
  if (!found) return false;
  // Velocity and bias: what the IMU predicted, not what a rejected fit left behind.
  relocalised_inertially_ = imu_ready() && imu_factor_;
  if (relocalised_inertially_) frame_.state = imu_factor_->predict(previous_state_);
  stereo_matches_.clear();
  frame_.state.T_world_body = found->T_world_body;
  frame_.landmarks = std::move(found->landmarks);
  // The jump makes the IMU factor from the last frame meaningless: start again from vision.
  imu_factor_ = nullptr;
  prior_.reset();
  velocity_known_ = false;
  return true;
}

void Tracker::finish_lost(TrackResult& result) {
  if (state_ == State::kTracking) {
    state_ = State::kRecentlyLost;
    lost_since_ns_ = frame_.stamp_ns;
    result.reason = "only " + std::to_string(inliers_) + " landmarks agree with the pose";
  }
  const bool inertial = imu_ready() && imu_factor_;
  const double patience =
      imu_ready() ? options_.recently_lost_inertial_s : options_.recently_lost_s;
  motion_s_ = 0;
  if (inertial) {
    // Dead reckoning keeps the prediction alive for the next frames.
    frame_.state = imu_factor_->predict(previous_state_);
    last_->state = frame_.state;
    last_->stamp_ns = frame_.stamp_ns;
    last_->features = frame_.features;
    last_->landmarks.assign(frame_.features->size(), LandmarkId{});
    last_->T_reference_body =
        snapshot_->T_world_body(last_->reference).inverse() * frame_.state.T_world_body;
    // The next fit must not hold this state fixed: it starts at the newest keyframe, with the drift
    // since then.
    prior_.reset();
    velocity_known_ = false;
    result.has_pose = true;
    result.T_world_body = frame_.state.T_world_body;
    result.reference = last_->reference;
    result.T_reference_body = last_->T_reference_body;
  }
  if (to_seconds(frame_.stamp_ns - lost_since_ns_) > patience) {
    state_ = State::kLost;
    result.reason =
        "not found again within " + std::to_string(patience) + " s: " +
        (options_.localize_only ? "searched in the whole map" : "a new map will be started");
    result.has_pose = false;
  }
}

}  // namespace fastloop::tracking
