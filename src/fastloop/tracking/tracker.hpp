#pragma once

#include <deque>
#include <map>
#include <memory>

#include "fastloop/core/timing.hpp"
#include "fastloop/optimization/pose_only.hpp"
#include "fastloop/tracking/keyframe_policy.hpp"
#include "fastloop/tracking/last_frame_search.hpp"
#include "fastloop/tracking/local_map.hpp"
#include "fastloop/tracking/relocalizer.hpp"
#include "fastloop/tracking/types.hpp"

namespace fastloop::tracking {

/// Pose of every frame against the map: prediction (IMU or constant velocity), search in the last
/// frame, search in the local map, pose-only optimisation, decision on keyframes, relocalisation
/// when lost.
///
/// Synchronous; one thread at a time. Reads snapshots only; what should enter the map leaves as a
/// KeyframeRequest. Snapshots may lag behind the requests, except that the first keyframe of a map
/// must be in the snapshot of the next frame (InvalidArgument). Deterministic for the same sequence
/// of frames and snapshots.
class Tracker {
 public:
  /// @param imu    noise of the IMU; needed when options.use_imu
  /// @param times  may be null; stages "predict", "last_frame", "local_map", "pose"
  Tracker(const TrackingOptions& options, const std::optional<ImuCalibration>& imu,
          StageTimes* times);

  /// Where relocalisation looks first; see Relocalizer.
  void set_candidate_source(Relocalizer::CandidateSource source) {
    relocalizer_.set_candidate_source(std::move(source));
  }

  struct Input {
    FrameId id;
    Nanoseconds stamp_ns = 0;
    std::shared_ptr<const FeatureSet> features;
    const std::vector<ImuSample>* imu = nullptr;  ///< as FrameInput::imu
    bool mapping_idle = true;
    bool mapping_full =
        false;  ///< live operation and mapping is far behind: no keyframe may be requested
  };
  TrackResult track(const Input& input, const std::shared_ptr<const map::Snapshot>& snapshot);

 private:
  void begin_frame(const Input& input);
  void append_imu(const std::vector<ImuSample>& samples);
  TrackResult initialise(const Input& input);
  TrackResult localise();
  SE3 level_pose(const Input& input) const;
  void follow_map_changes();
  void predict();
  bool search_in_last_frame();
  bool search_in_local_map();
  bool optimise_against_local_map();
  bool optimise(const std::vector<optimization::PoseObservation>& observations,
                std::vector<std::uint8_t>& inlier);
  void record_sightings(const matching::ProjectionMatches& matches);
  bool relocalise();
  void finish_tracked(const Input& input, TrackResult& result);
  void finish_lost(TrackResult& result);
  map::KeyframeRequest make_request(bool starts_map);
  bool wants_keyframe(const Input& input) const;
  std::shared_ptr<const PreintegratedImu> preintegrate(Nanoseconds begin_ns, Nanoseconds end_ns,
                                                       const ImuBias&) const;
  std::vector<optimization::PoseObservation> observations_of(
      const std::vector<std::uint32_t>& keypoints, const std::vector<Vector3d>& p_world) const;
  bool imu_ready() const;
  bool map_exists() const { return map_.valid() && map_.value() < snapshot_->maps().size(); }
  float close_depth_m() const;

  TrackingOptions options_;
  std::optional<ImuCalibration> imu_calibration_;
  StageTimes* times_;
  Relocalizer relocalizer_;
  LocalMap local_map_;

  State state_ = State::kInitialising;
  std::shared_ptr<const map::Snapshot> snapshot_;
  TrackedFrame frame_;
  std::optional<TrackedFrame> last_;
  SE3 motion_;           ///< T_previousbody_body of the last step
  double motion_s_ = 0;  ///< its duration; 0 = unknown
  int inliers_ = 0;
  std::vector<PointMatch>
      stereo_matches_;  ///< of this frame: last frame's stereo points without landmark

  MapId map_;  ///< map in use; maps are numbered in the order they are started
  std::uint32_t maps_started_ = 0;
  KeyframeId last_keyframe_;         ///< last requested
  std::uint32_t next_keyframe_ = 0;  ///< slot of the next request
  Nanoseconds last_keyframe_ns_ = 0;
  std::uint64_t pose_version_ = 0;
  Nanoseconds lost_since_ns_ = 0;

  std::deque<ImuSample> imu_;  ///< since the newest keyframe in use
  bool from_keyframe_ =
      false;  ///< this frame's IMU factor starts at a keyframe instead of the last frame
  bool velocity_known_ = false;
  bool relocalised_inertially_ = false;  ///< this frame, after dead reckoning
  NavState previous_state_;              ///< start of the IMU factor
  std::shared_ptr<const PreintegratedImu> imu_factor_;
  std::optional<optimization::NavPrior> prior_;  ///< on the last frame

  std::map<LandmarkId, std::pair<std::uint32_t, std::uint32_t>> sightings_;
};

}  // namespace fastloop::tracking
