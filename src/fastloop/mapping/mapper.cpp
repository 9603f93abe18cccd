#include "fastloop/mapping/mapper.hpp"

#include "fastloop/core/error.hpp"
#include "fastloop/mapping/landmark_creation.hpp"
#include "fastloop/mapping/landmark_fusion.hpp"
#include "fastloop/mapping/local_adjustment.hpp"

namespace fastloop::mapping {
namespace {
constexpr Nanoseconds kImuRetryNs = 500'000'000;  ///< between failed attempts to initialise the IMU
}

void MappingOptions::validate() const {
  const auto require = [](bool ok, const char* what) {
    if (!ok) throw InvalidArgument(std::string("MappingOptions::") + what);
  };
  require(close_depth_baselines > 0, "close_depth_baselines must be positive");
  require(window_keyframes >= 2 && window_keyframes_inertial >= 2,
          "window_keyframes must be at least 2");
  require(adjustment_iterations >= 1, "adjustment_iterations must be at least 1");
  require(threads >= 1, "threads must be at least 1");
  require(redundant_share > 0 && redundant_share_inertial > 0, "redundant_share must be positive");
  require(imu_min_keyframes >= 3, "imu_min_keyframes must be at least 3");
}

Mapper::Mapper(const StereoRig& rig, const PyramidScales& scales, const MappingOptions& options,
               Callbacks callbacks, StageTimes* times)
    : options_(options), callbacks_(std::move(callbacks)), times_(times), map_(rig, scales) {
  options_.validate();
}

void Mapper::publish() {
  if (callbacks_.publish) callbacks_.publish(map_.publish());
}

map::CorrectionOutcome Mapper::apply(const map::LoopCorrection& correction) {
  const ScopedTimer timer(times_, "apply_correction");
  return map::apply_correction(map_, correction);
}

KeyframeId Mapper::insert(const map::KeyframeRequest& r) {
  const ScopedTimer timer(times_, "insert");
  for (const map::Sighting& s : r.sightings) {
    const LandmarkId id = map_.resolve(s.landmark);
    if (id.valid()) map_.count_visible(id, s.visible, s.found);
  }
  NavState state = r.state;
  MapId map_id;
  if (r.starts_map) {
    map_id = map_.start_map();
  } else {
    map_id = map_.keyframe(r.reference).map;
    const SE3 moved = map_.T_world_body(r.reference) * r.T_reference_body;
    state.v_world = (moved.rotation * r.state.T_world_body.rotation.conjugate()) * state.v_world;
    state.T_world_body = moved;
  }
  const KeyframeId id = map_.add_keyframe(map_id, r.data, state, r.imu_from_previous);
  if (id != r.id) throw Error("keyframe requests arrived out of order");
  for (std::uint32_t i = 0; i < r.landmarks.size(); ++i) {
    const LandmarkId landmark = map_.resolve(r.landmarks[i]);
    if (landmark.valid() && map_.add_observation(landmark, id, i)) map_.refresh_landmark(landmark);
  }
  return id;
}

void Mapper::process(const map::KeyframeRequest& request, bool more_waiting) {
  const KeyframeId id = insert(request);
  const MapId map_id = map_.keyframe(id).map;
  {
    const ScopedTimer timer(times_, "create");
    probation_.review(map_, id);
    probation_.add(create_from_stereo(map_, id, options_));
    map_.attach_to_spanning_tree(id);
  }
  publish();
  if (request.starts_map) return;
  {
    const ScopedTimer timer(times_, "create");
    probation_.add(create_by_triangulation(map_, id, options_));
  }
  {
    const ScopedTimer timer(times_, "fuse");
    fuse_with_neighbours(map_, id, options_);
  }
  publish();
  const bool inertial = options_.use_imu && map_.map_info(map_id).imu_initialized;
  if (!more_waiting) {
    const ScopedTimer timer(times_, "adjust");
    adjust_locally(map_, id, inertial, options_, &cancel_);
  }
  {
    const ScopedTimer timer(times_, "cull");
    cull_keyframes(map_, id, inertial, options_);
  }
  if (options_.use_imu && request.data->stamp_ns - last_imu_attempt_ns_ >= kImuRetryNs) {
    const ScopedTimer timer(times_, "imu");
    const ImuStep step = align_to_imu(map_, map_id, options_, &cancel_);
    if (step.kind != ImuStep::Kind::kNone) {
      last_imu_attempt_ns_ = request.data->stamp_ns;
      if (callbacks_.imu_event) callbacks_.imu_event(request.data->stamp_ns, step);
    }
  }
  publish();
}

}  // namespace fastloop::mapping
