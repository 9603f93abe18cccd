#include "fastloop/tracking/tracker.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"

namespace fastloop::tracking {
namespace {

constexpr int kEnoughLastFrameInliers = 10;
constexpr int kFewLastFrameMatches = 20;
constexpr Nanoseconds kMaxImuGapNs =
    50'000'000;  ///< longer without a measurement is not integrated over
constexpr std::size_t kStereoPointsHelpBelow =
    100;  ///< landmarks; above, unmapped stereo points are left out

/// Whether the measurements tell the motion of the whole interval.
bool covers(const std::vector<ImuSample>& samples, Nanoseconds begin_ns, Nanoseconds end_ns) {
  Nanoseconds known = begin_ns;
  for (const ImuSample& s : samples) {
    if (s.stamp_ns - known > kMaxImuGapNs) return false;
    known = std::max(known, s.stamp_ns);
  }
  // Only a stale measurement at or before the beginning covers nothing.
  return known > begin_ns && end_ns - known <= kMaxImuGapNs;
}

}  // namespace

Tracker::Tracker(const TrackingOptions& options, const std::optional<ImuCalibration>& imu,
                 StageTimes* times)
    : options_(options), imu_calibration_(imu), times_(times) {
  options_.validate();
  if (options_.use_imu && !imu)
    throw InvalidArgument("TrackingOptions::use_imu needs an IMU calibration");
  if (imu_calibration_) {
    imu_calibration_->gyro_noise_density *= options_.imu_noise_factor;
    imu_calibration_->accel_noise_density *= options_.imu_noise_factor;
  }
}

bool Tracker::imu_ready() const {
  return options_.use_imu && map_exists() && snapshot_->map_info(map_).imu_initialized;
}

float Tracker::close_depth_m() const {
  return static_cast<float>(options_.close_depth_baselines * snapshot_->rig().baseline_m);
}

TrackResult Tracker::track(const Input& input,
                           const std::shared_ptr<const map::Snapshot>& snapshot) {
  snapshot_ = snapshot;
  begin_frame(input);
  if (state_ == State::kInitialising || state_ == State::kLost)
    return options_.localize_only ? localise() : initialise(input);

  if (last_->reference.value() >= snapshot_->keyframe_slots())
    throw InvalidArgument(
        "the first keyframe of a map must be in the snapshot before the next frame is tracked");
  follow_map_changes();
  predict();
  const bool searched = search_in_last_frame();
  bool tracked = (searched || imu_ready()) && search_in_local_map();
  if (!tracked && relocalise()) tracked = search_in_local_map();

  TrackResult result;
  if (tracked)
    finish_tracked(input, result);
  else
    finish_lost(result);
  result.state = state_;
  result.inliers = inliers_;
  return result;
}

void Tracker::begin_frame(const Input& input) {
  frame_ = TrackedFrame{};
  frame_.id = input.id;
  frame_.stamp_ns = input.stamp_ns;
  frame_.features = input.features;
  frame_.landmarks.assign(input.features->size(), LandmarkId{});
  stereo_matches_.clear();
  relocalised_inertially_ = false;
  inliers_ = 0;
  if (options_.use_imu && input.imu) append_imu(*input.imu);
}

void Tracker::append_imu(const std::vector<ImuSample>& samples) {
  for (const ImuSample& s : samples)
    if (imu_.empty() || s.stamp_ns > imu_.back().stamp_ns) imu_.push_back(s);
}

std::shared_ptr<const PreintegratedImu> Tracker::preintegrate(Nanoseconds begin_ns,
                                                              Nanoseconds end_ns,
                                                              const ImuBias& bias) const {
  // The sample at or before the beginning up to the one at or after the end.
  auto first = std::upper_bound(imu_.begin(), imu_.end(), begin_ns,
                                [](Nanoseconds t, const ImuSample& s) { return t < s.stamp_ns; });
  if (first != imu_.begin()) --first;
  auto last = std::lower_bound(first, imu_.end(), end_ns,
                               [](const ImuSample& s, Nanoseconds t) { return s.stamp_ns < t; });
  if (last != imu_.end()) ++last;
  const std::vector<ImuSample> samples(first, last);
  if (end_ns <= begin_ns || !covers(samples, begin_ns, end_ns)) return nullptr;
  return std::make_shared<const PreintegratedImu>(samples, begin_ns, end_ns, bias,
                                                  *imu_calibration_);
}

/// First pose of a map: level when the IMU can tell where down is, otherwise the origin.
SE3 Tracker::level_pose(const Input& input) const {
  if (!options_.use_imu || !input.imu || input.imu->empty()) return SE3{};
  Vector3d up_body = Vector3d::Zero();
  for (const ImuSample& s : *input.imu) up_body += s.accel;
  if (up_body.norm() < 1e-3) return SE3{};
  return SE3(Eigen::Quaterniond::FromTwoVectors(up_body.normalized(), Vector3d::UnitZ()),
             Vector3d::Zero());
}

TrackResult Tracker::initialise(const Input& input) {
  TrackResult result;
  int with_depth = 0;
  for (std::size_t i = 0; i < frame_.features->size(); ++i)
    with_depth += frame_.features->has_depth(i);
  if (with_depth < options_.min_initial_depth_points) {
    state_ = State::kInitialising;
    imu_.clear();  // nothing starts here; the next frame brings the samples around this one again
    result.state = state_;
    result.reason = "only " + std::to_string(with_depth) + " keypoints with depth, " +
                    std::to_string(options_.min_initial_depth_points) + " needed";
    return result;
  }
  frame_.state.T_world_body = level_pose(input);
  // The number the map will get: after those of the snapshot and those requested since.
  maps_started_ = std::max(maps_started_, static_cast<std::uint32_t>(snapshot_->maps().size()));
  map_ = MapId(maps_started_++);
  // Requests still waiting to be mapped have taken slots that the snapshot does not show yet.
  next_keyframe_ =
      std::max(next_keyframe_, static_cast<std::uint32_t>(snapshot_->keyframe_slots()));
  motion_s_ = 0;
  prior_.reset();
  velocity_known_ = false;
  state_ = State::kTracking;
  inliers_ = with_depth;
  last_ = frame_;
  last_->reference = KeyframeId(next_keyframe_);
  result.keyframe = make_request(true);
  result.state = state_;
  result.reason = "map started with " + std::to_string(with_depth) + " points";
  result.has_pose = true;
  result.T_world_body = frame_.state.T_world_body;
  result.reference = result.keyframe->id;
  result.inliers = with_depth;
  pose_version_ = 0;
  return result;
}

/// Mapping may have moved keyframes since the last frame: the last frame moves along.
void Tracker::follow_map_changes() {
  from_keyframe_ = false;
  if (snapshot_->pose_version() != pose_version_) {
    const SE3 moved = snapshot_->T_world_body(last_->reference) * last_->T_reference_body;
    const SE3 correction = moved * last_->state.T_world_body.inverse();
    last_->state.T_world_body = moved;
    last_->state.v_world = correction.rotation * last_->state.v_world;
    if (prior_) {
      prior_->mean.T_world_body = correction * prior_->mean.T_world_body;
      prior_->mean.v_world = correction.rotation * prior_->mean.v_world;
    }
    pose_version_ = snapshot_->pose_version();
    if (map_exists()) map_ = snapshot_->resolve(map_);
    from_keyframe_ = snapshot_->contains(last_keyframe_);
  }
  if (imu_ready() && !velocity_known_) from_keyframe_ = true;
  // Where the last frame became a keyframe, mapping has found or created landmarks for it since.
  if (snapshot_->contains(last_keyframe_) &&
      snapshot_->keyframe(last_keyframe_).data->frame == last_->id) {
    last_->landmarks = snapshot_->keyframe(last_keyframe_).landmarks;
    last_->reference = last_keyframe_;
    last_->T_reference_body =
        snapshot_->T_world_body(last_keyframe_).inverse() * last_->state.T_world_body;
  }
}

void Tracker::predict() {
  const ScopedTimer timer(times_, "predict");
  imu_factor_ = nullptr;
  const double dt = to_seconds(frame_.stamp_ns - last_->stamp_ns);
  if (imu_ready()) {
    const KeyframeId newest = snapshot_->map_info(map_).last_keyframe;
    const map::Keyframe& k = snapshot_->keyframe(newest);
    // A keyframe state is only usable while the measurements since then are at hand.
    const bool covered = !imu_.empty() && imu_.front().stamp_ns <= k.data->stamp_ns;
    if (from_keyframe_ && !covered) from_keyframe_ = false;
    previous_state_ = from_keyframe_ ? k.state : last_->state;
    imu_factor_ = preintegrate(from_keyframe_ ? k.data->stamp_ns : last_->stamp_ns, frame_.stamp_ns,
                               previous_state_.bias);
    if (imu_factor_) {
      frame_.state = imu_factor_->predict(previous_state_);
      return;
    }
  }
  frame_.state = last_->state;
  SE3 step;
  if (motion_s_ > 0) {
    const double ratio = dt / motion_s_;
    step = SE3(so3::exp(ratio * so3::log(motion_.rotation)), ratio * motion_.translation);
  }
  if (options_.use_imu) {
    // Before the IMU is initialised its gyroscope already tells the rotation; translation goes on
    // as it was.
    if (const auto imu = preintegrate(last_->stamp_ns, frame_.stamp_ns, last_->state.bias)) {
      step = SE3(imu->delta_rotation(last_->state.bias), step.translation);
    }
  }
  frame_.state.T_world_body = last_->state.T_world_body * step;
}

std::vector<optimization::PoseObservation> Tracker::observations_of(
    const std::vector<std::uint32_t>& keypoints, const std::vector<Vector3d>& p_world) const {
  const FeatureSet& f = *frame_.features;
  std::vector<optimization::PoseObservation> observations(keypoints.size());
  for (std::size_t i = 0; i < keypoints.size(); ++i) {
    const std::uint32_t k = keypoints[i];
    observations[i].p_world = p_world[i];
    observations[i].pixel.left = {f.x[k], f.y[k]};
    observations[i].pixel.right = {f.right_x[k], f.right_y[k]};
    observations[i].inv_sigma2 = 1.0 / snapshot_->scales().sigma2[f.octave[k]];
  }
  return observations;
}

bool Tracker::search_in_last_frame() {
  const ScopedTimer timer(times_, "last_frame");
  const float radius =
      imu_ready() ? options_.last_frame_radius_inertial_px : options_.last_frame_radius_px;
  std::vector<PointMatch> matches;
  for (const float factor : {1.f, 2.f, 4.f}) {
    matches = search_last_frame(*snapshot_, *last_, *frame_.features, frame_.state.T_world_body,
                                factor * radius, close_depth_m());
    if (matches.size() >= kFewLastFrameMatches) break;
  }
  std::vector<std::uint32_t> keypoints;
  std::vector<Vector3d> points;
  for (const PointMatch& m : matches) {
    keypoints.push_back(m.keypoint);
    points.push_back(m.p_world);
  }
  const auto fit = optimization::optimize_pose(snapshot_->rig(), frame_.state.T_world_body,
                                               observations_of(keypoints, points));
  if (fit.num_inliers < kEnoughLastFrameInliers) return false;
  frame_.state.T_world_body = fit.T_world_body;
  for (std::size_t i = 0; i < matches.size(); ++i) {
    if (!fit.inlier[i]) continue;
    if (matches[i].landmark.valid())
      frame_.landmarks[matches[i].keypoint] = matches[i].landmark;
    else
      stereo_matches_.push_back(matches[i]);
  }
  return true;
}

bool Tracker::search_in_local_map() {
  const bool any = std::any_of(frame_.landmarks.begin(), frame_.landmarks.end(),
                               [](LandmarkId id) { return id.valid(); });
  matching::ProjectionMatches matches;
  {
    const ScopedTimer timer(times_, "local_map");
    const KeyframeId recent =
        imu_ready() ? snapshot_->map_info(map_).last_keyframe : last_->reference;
    local_map_.update(*snapshot_, any ? frame_.landmarks : last_->landmarks, recent,
                      options_.max_local_keyframes);

    std::vector<std::uint8_t> blocked(frame_.landmarks.size(), 0),
        skipped(local_map_.ids().size(), 0);
    for (std::size_t i = 0; i < frame_.landmarks.size(); ++i) {
      if (!frame_.landmarks[i].valid()) continue;
      blocked[i] = 1;
      const auto it =
          std::lower_bound(local_map_.ids().begin(), local_map_.ids().end(), frame_.landmarks[i]);
      if (it != local_map_.ids().end() && *it == frame_.landmarks[i])
        skipped[static_cast<std::size_t>(it - local_map_.ids().begin())] = 1;
    }
    matching::ProjectionSearchOptions rule;
    rule.radius_px = 2.5f;
    rule.wide_view_cos = 0.998f;
    rule.wide_factor = 1.6f;
    if (state_ == State::kRecentlyLost || !any) rule.radius_px *= 4;
    rule.max_distance = 100;
    rule.best_to_second = 0.8f;
    const matching::SearchTarget target{
        frame_.features.get(), (frame_.state.T_world_body * snapshot_->rig().T_body_left).inverse(),
        1, blocked, skipped};
    matching::search_by_projection(Executor::cpu(), snapshot_->rig(), snapshot_->scales(),
                                   {&target, 1}, local_map_.view(), rule, {&matches, 1});
    for (std::size_t i = 0; i < matches.keypoint.size(); ++i)
      if (matches.keypoint[i] != matching::kNoMatch)
        frame_.landmarks[static_cast<std::size_t>(matches.keypoint[i])] = local_map_.ids()[i];
  }
  const bool ok = optimise_against_local_map();
  if (ok) record_sightings(matches);
  return ok;
}

bool Tracker::optimise_against_local_map() {
  const ScopedTimer timer(times_, "pose");
  std::vector<std::uint32_t> keypoints;
  std::vector<Vector3d> points;
  for (std::uint32_t i = 0; i < frame_.landmarks.size(); ++i)
    if (frame_.landmarks[i].valid()) {
      keypoints.push_back(i);
      points.push_back(snapshot_->p_world(frame_.landmarks[i]));
    }
  const std::size_t num_landmarks = keypoints.size();
  // Stereo points of a lost frame hang on its guessed pose: only landmarks lead back to the map.
  if (num_landmarks < kStereoPointsHelpBelow && state_ != State::kRecentlyLost)
    for (const PointMatch& m : stereo_matches_)
      if (!frame_.landmarks[m.keypoint].valid()) {
        keypoints.push_back(m.keypoint);
        points.push_back(m.p_world);
      }
  std::vector<std::uint8_t> inlier;
  if (!optimise(observations_of(keypoints, points), inlier)) return false;
  inliers_ = 0;
  int stereo_inliers = 0;
  for (std::size_t i = 0; i < keypoints.size(); ++i) {
    if (i >= num_landmarks)
      stereo_inliers += inlier[i];
    else if (inlier[i])
      ++inliers_;
    else
      frame_.landmarks[keypoints[i]] = LandmarkId{};
  }
  const int needed = imu_ready() ? options_.min_inliers_inertial : options_.min_inliers;
  return inliers_ + stereo_inliers >= needed && frame_.state.T_world_body.is_finite();
}

bool Tracker::optimise(const std::vector<optimization::PoseObservation>& observations,
                       std::vector<std::uint8_t>& inlier) {
  if (observations.size() < 3) return false;
  if (imu_ready() && imu_factor_) {
    optimization::InertialPoseProblem problem;
    problem.rig = &snapshot_->rig();
    problem.observations = observations;
    problem.previous = previous_state_;
    problem.imu = imu_factor_.get();
    if (!from_keyframe_) problem.prior = prior_;
    problem.initial = frame_.state;
    auto fit = optimization::optimize_pose_inertial(problem);
    frame_.state = fit.state;
    prior_ = std::move(fit.prior);
    inlier = std::move(fit.inlier);
    velocity_known_ = true;
    return true;
  }
  // Without measurements nothing is known of the velocity: the next IMU factor starts at a
  // keyframe.
  prior_.reset();
  velocity_known_ = false;
  auto fit = optimization::optimize_pose(snapshot_->rig(), frame_.state.T_world_body, observations);
  frame_.state.T_world_body = fit.T_world_body;
  inlier = std::move(fit.inlier);
  return true;
}

void Tracker::record_sightings(const matching::ProjectionMatches& matches) {
  for (std::size_t i = 0; i < matches.in_view.size(); ++i)
    if (matches.in_view[i]) ++sightings_[local_map_.ids()[i]].first;
  for (const LandmarkId id : frame_.landmarks)
    if (id.valid()) {
      auto& [visible, found] = sightings_[id];
      ++found;
      if (visible < found)
        visible = found;  // found in the last frame, so not searched in the local map
    }
}

void Tracker::finish_tracked(const Input& input, TrackResult& result) {
  if (state_ == State::kRecentlyLost)
    result.reason = "relocalised with " + std::to_string(inliers_) + " landmarks";
  state_ = State::kTracking;
  frame_.reference = local_map_.reference().valid() ? local_map_.reference() : last_->reference;
  frame_.T_reference_body =
      snapshot_->T_world_body(frame_.reference).inverse() * frame_.state.T_world_body;
  const double dt = to_seconds(frame_.stamp_ns - last_->stamp_ns);
  motion_ = last_->state.T_world_body.inverse() * frame_.state.T_world_body;
  motion_s_ = relocalised_inertially_ ? 0 : dt;
  // From the dead-reckoned last pose to a relocalised one is a jump, no motion.
  if (!relocalised_inertially_ && !(imu_ready() && imu_factor_))
    frame_.state.v_world =
        (frame_.state.T_world_body.translation - last_->state.T_world_body.translation) / dt;
  result.has_pose = true;
  result.T_world_body = frame_.state.T_world_body;
  result.reference = frame_.reference;
  result.T_reference_body = frame_.T_reference_body;
  last_ = frame_;
  if (wants_keyframe(input)) {
    result.keyframe = make_request(false);
    result.reference = result.keyframe->id;
    result.T_reference_body = SE3{};
  }
}

bool Tracker::wants_keyframe(const Input& input) const {
  if (input.mapping_full || options_.localize_only) return false;
  KeyframeSituation s;
  s.seconds_since_keyframe = to_seconds(frame_.stamp_ns - last_keyframe_ns_);
  s.inliers = inliers_;
  const bool young = snapshot_->map_info(map_).num_keyframes <= 2;
  s.reference_landmarks = snapshot_->count_tracked(frame_.reference, young ? 1 : 2);
  s.mapping_idle = input.mapping_idle;
  s.imu_initialized = imu_ready();
  count_close_points(frame_, close_depth_m(), s);
  return needs_keyframe(s, options_);
}

map::KeyframeRequest Tracker::make_request(bool starts_map) {
  map::KeyframeRequest r;
  r.id = KeyframeId(next_keyframe_++);
  auto data = std::make_shared<map::KeyframeData>();
  data->frame = frame_.id;
  data->stamp_ns = frame_.stamp_ns;
  data->features = frame_.features;
  r.data = std::move(data);
  r.state = frame_.state;
  r.landmarks = frame_.landmarks;
  r.starts_map = starts_map;
  if (!starts_map) {
    r.reference = frame_.reference;
    r.T_reference_body = frame_.T_reference_body;
    if (options_.use_imu)
      r.imu_from_previous = preintegrate(last_keyframe_ns_, frame_.stamp_ns, frame_.state.bias);
  }
  for (const auto& [id, counts] : sightings_)
    r.sightings.push_back({id, counts.first, counts.second});
  sightings_.clear();
  last_keyframe_ = r.id;
  last_keyframe_ns_ = frame_.stamp_ns;
  // Measurements are kept back to the newest keyframe that mapping has finished.
  const Nanoseconds keep_from =
      map_exists() && snapshot_->map_info(map_).last_keyframe.valid()
          ? snapshot_->keyframe(snapshot_->map_info(map_).last_keyframe).data->stamp_ns
          : frame_.stamp_ns;
  while (imu_.size() > 2 && imu_[1].stamp_ns <= keep_from) imu_.pop_front();
  return r;
}

}  // namespace fastloop::tracking
