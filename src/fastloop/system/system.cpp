#include "fastloop/system/system.hpp"

#include <algorithm>
#include <mutex>

#include "fastloop/core/error.hpp"
#include "fastloop/core/logging.hpp"
#include "fastloop/system/mapping_worker.hpp"
#include "fastloop/tracking/tracker.hpp"

namespace fastloop::system {
namespace {

Mode resolve_mode(Mode wanted, const Calibration& c) {
  const bool stereo = c.cameras.size() == 2;
  if (wanted == Mode::kAuto) {
    if (c.depth && !stereo) return Mode::kRgbd;
    return c.imu ? Mode::kStereoInertial : Mode::kStereo;
  }
  if (wanted == Mode::kRgbd && !c.depth) throw InvalidArgument("mode rgbd needs a depth camera");
  if (wanted != Mode::kRgbd && !stereo) throw InvalidArgument("stereo modes need two cameras");
  if (wanted == Mode::kStereoInertial && !c.imu)
    throw InvalidArgument("mode stereo-inertial needs an IMU");
  return wanted;
}

SystemOptions complete(SystemOptions options, Mode mode) {
  options.mode = mode;
  options.tracking.localize_only = options.localize_only;
  options.tracking.use_imu = mode == Mode::kStereoInertial && !options.localize_only;
  options.mapping.use_imu = options.loops.loop.inertial = options.tracking.use_imu;
  return options;
}

WorkerPace pace_of(const SystemOptions& options) {
  return {!options.deterministic, options.drop_when_busy,
          static_cast<std::uint32_t>(options.mapping_delay_frames)};
}

bool is_finite(const ImuSample& s) {
  return s.gyro.allFinite() && s.accel.allFinite();
}

bool same_rig(const StereoRig& a, const StereoRig& b) {
  const auto same_camera = [](const Camera& x, const Camera& y) {
    return x.model == y.model && x.width == y.width && x.height == y.height && x.fx == y.fx &&
           x.fy == y.fy && x.cx == y.cx && x.cy == y.cy && x.distortion == y.distortion;
  };
  return a.kind == b.kind && same_camera(a.left, b.left) && a.baseline_m == b.baseline_m &&
         (a.kind == StereoRig::Kind::kRectified || same_camera(a.right, b.right));
}

const char* event_kind(tracking::State before, tracking::State after) {
  using tracking::State;
  if (after == State::kTracking)
    return before == State::kRecentlyLost ? "relocalised" : "initialised";
  if (after == State::kRecentlyLost) return "recently_lost";
  return after == State::kLost ? "lost" : "initialising";
}

}  // namespace

const char* to_string(Mode mode) {
  switch (mode) {
    case Mode::kAuto:
      return "auto";
    case Mode::kStereo:
      return "stereo";
    case Mode::kStereoInertial:
      return "stereo-inertial";
    case Mode::kRgbd:
      return "rgbd";
  }
  return "unknown";
}

void SystemOptions::validate() const {
  if (mapping_delay_frames < 1)
    throw InvalidArgument("SystemOptions::mapping_delay_frames must be at least 1");
  orb.validate();
  tracking.validate();
  mapping.validate();
  loops.validate();
  if (localize_only && !initial_map) throw InvalidArgument("localisation needs a map");
}

struct System::Impl {
  SystemOptions options;
  StageTimes times;
  FrameBuilder builder;
  tracking::Tracker tracker;
  mutable std::mutex events_mutex;
  std::vector<Event> events;
  std::vector<FrameRecord> frames;
  MappingWorker worker;
  tracking::State state = tracking::State::kInitialising;
  std::string initialising_reason;
  bool finished = false;

  Impl(const Calibration& calibration, const SystemOptions& given)
      : options(complete(given, resolve_mode(given.mode, calibration))),
        builder(calibration, options.orb),
        tracker(options.tracking, calibration.imu, &times),
        worker(
            builder.rig(), PyramidScales(options.orb.levels, options.orb.scale_factor),
            options.mapping, pace_of(options), options.loops,
            {[this](Nanoseconds stamp, const mapping::ImuStep& step) { on_imu(stamp, step); },
             [this](const LoopRecord& record) { on_loop(record); }},
            options.initial_map, &times) {
    tracker.set_candidate_source([this](const FeatureSet& features, const map::Snapshot& snapshot) {
      return similar_keyframes(worker.loops().database(), features, snapshot);
    });
  }

  void add_event(Event event) {
    logger("system").info("{:.3f} {}: {}", to_seconds(event.stamp_ns), event.kind, event.reason);
    const std::lock_guard lock(events_mutex);
    events.push_back(std::move(event));
  }

  void on_imu(Nanoseconds stamp_ns, const mapping::ImuStep& step) {
    using Kind = mapping::ImuStep::Kind;
    const char* kind = step.kind == Kind::kInitialised ? "imu_initialised"
                       : step.kind == Kind::kRefined   ? "imu_refined"
                                                       : "imu_failed";
    add_event({stamp_ns, kind, step.reason, {}, {}});
  }

  void on_loop(const LoopRecord& record) {
    const map::CorrectionOutcome& outcome = *record.correction;
    Event event{record.report.stamp_ns, "loop_refused", record.report.reason, {}, {}};
    if (outcome.applied) {
      event.kind = record.merge ? "maps_merged" : "loop_closed";
      event.reason = std::to_string(outcome.moved) + " keyframes moved, " +
                     std::to_string(outcome.merged) + " landmarks joined";
      event.T_new_old = outcome.T_new_old;
    }
    add_event(std::move(event));
  }

  /// The samples of a frame that can be integrated; the rest is reported. `storage` holds them when
  /// some had to go.
  const std::vector<ImuSample>* usable_imu(const FrameInput& input,
                                           std::vector<ImuSample>& storage) {
    const auto bad = std::count_if(input.imu.begin(), input.imu.end(),
                                   [](const auto& i) { return !is_finite(i); });
    if (bad == 0) return &input.imu;
    add_event(
        {input.stamp_ns, "imu_ignored", std::to_string(bad) + " IMU samples are not finite", {}, {}});
    std::copy_if(input.imu.begin(), input.imu.end(), std::back_inserter(storage), is_finite);
    return &storage;
  }

  void note_state(const FrameRecord& record, const std::string& reason) {
    // A waiting initialisation would repeat itself every frame: only a change of state or the first
    // reason counts.
    const bool waiting = record.state == tracking::State::kInitialising && state == record.state;
    if (waiting && (!initialising_reason.empty() || reason.empty())) return;
    if (record.state != state || !reason.empty())
      add_event({record.stamp_ns, event_kind(state, record.state), reason, {}, {}});
    initialising_reason = record.state == tracking::State::kInitialising ? reason : "";
    state = record.state;
  }
};

System::System(const Calibration& calibration, const SystemOptions& options) {
  calibration.validate();
  options.validate();
  impl_ = std::make_unique<Impl>(calibration, options);
  if (options.initial_map && !same_rig(options.initial_map->rig(), impl_->builder.rig()))
    throw InvalidArgument("the map was made with other cameras than those of this data");
}

System::~System() = default;

const FrameRecord& System::process(const FrameInput& input) {
  Impl& s = *impl_;
  if (s.finished) throw InvalidArgument("the run is finished: no more frames");
  if (!s.frames.empty() && input.stamp_ns <= s.frames.back().stamp_ns)
    throw InvalidArgument("frames must come in time order");
  const Stopwatch watch;
  const auto frame = static_cast<std::uint32_t>(s.frames.size());
  tracking::Tracker::Input in;
  in.id = FrameId(frame);
  in.stamp_ns = input.stamp_ns;
  in.features = std::make_shared<const FeatureSet>(s.builder.build(input, &s.times));
  std::vector<ImuSample> finite_imu;
  in.imu = s.usable_imu(input, finite_imu);
  const Stopwatch wait_watch;
  const MappingWorker::View view = s.worker.view(frame);
  const double waited_ms = wait_watch.elapsed_ms();
  s.times.add("wait_for_mapping", waited_ms);
  in.mapping_idle = view.idle;
  in.mapping_full = s.options.drop_when_busy && s.worker.full();
  tracking::TrackResult result = s.tracker.track(in, view.snapshot);

  FrameRecord record;
  record.stamp_ns = input.stamp_ns;
  record.state = result.state;
  record.has_pose = result.has_pose;
  record.live_T_world_body = result.T_world_body;
  record.reference = result.reference;
  record.T_reference_body = result.T_reference_body;
  record.inliers = result.inliers;
  record.tracking_ms = watch.elapsed_ms() - waited_ms;
  s.times.add("track_total", record.tracking_ms);
  s.note_state(record, result.reason);
  s.frames.push_back(record);
  if (result.keyframe) s.worker.submit(std::move(*result.keyframe), frame);
  return s.frames.back();
}

void System::finish() {
  impl_->finished = true;
  impl_->worker.finish();
}

bool System::deterministic() const {
  return impl_->options.deterministic;
}
Mode System::mode() const {
  return impl_->options.mode;
}
std::shared_ptr<const map::Snapshot> System::snapshot() const {
  return impl_->worker.snapshot();
}
const std::vector<FrameRecord>& System::frames() const {
  return impl_->frames;
}
std::vector<LoopRecord> System::loops() const {
  return impl_->worker.loops().records();
}
const StageTimes& System::times() const {
  return impl_->times;
}

std::vector<Event> System::events() const {
  std::vector<Event> events;
  {
    const std::lock_guard lock(impl_->events_mutex);
    events = impl_->events;
  }
  std::stable_sort(events.begin(), events.end(),
                   [](const Event& a, const Event& b) { return a.stamp_ns < b.stamp_ns; });
  return events;
}

bool System::imu_initialized() const {
  for (const map::MapInfo& m : snapshot()->maps())
    if (m.imu_initialized) return true;
  return false;
}

std::optional<SE3> System::T_world_body(const FrameRecord& frame) const {
  if (!frame.has_pose) return std::nullopt;
  const auto map = snapshot();
  if (frame.reference.value() >= map->keyframe_slots()) return std::nullopt;
  return map->T_world_body(frame.reference) * frame.T_reference_body;
}

}  // namespace fastloop::system
