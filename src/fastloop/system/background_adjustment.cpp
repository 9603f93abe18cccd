#include "fastloop/system/background_adjustment.hpp"

#include "fastloop/core/thread_priority.hpp"
#include "fastloop/mapping/local_adjustment.hpp"

namespace fastloop::system {
namespace {

constexpr int kIterations = 10;  // as published without IMU; 7 with it

map::LoopCorrection difference(const map::Snapshot& before, const map::Snapshot& after, MapId id) {
  map::LoopCorrection c;
  c.kind = map::LoopCorrection::Kind::kAdjustment;
  c.frame_version = before.frame_version();
  c.map = id;
  for (std::uint32_t i = 0; i < before.keyframe_slots(); ++i) {
    const KeyframeId k(i);
    if (before.contains(k) && before.keyframe(k).map == id)
      c.states.push_back({k, before.keyframe(k).state, after.keyframe(k).state});
  }
  for (std::uint32_t i = 0; i < before.landmark_slots(); ++i) {
    const LandmarkId l(i);
    if (!before.contains(l) || !after.contains(l)) continue;
    const map::Landmark &was = before.landmark(l), &is = after.landmark(l);
    if (before.keyframe(was.anchor).map == id && was.anchor == is.anchor &&
        was.p_anchor != is.p_anchor)
      c.points.push_back({l, is.anchor, is.p_anchor});
  }
  return c;
}

}  // namespace

void BackgroundAdjustment::adjust(const map::Snapshot& snapshot, MapId id, bool inertial) {
  try {
    map::Map copy(snapshot);
    const auto result =
        mapping::adjust_whole_map(copy, id, inertial, kIterations, options_, &cancel_);
    if (result.usable && !cancel_) result_ = difference(snapshot, copy, id);
  } catch (...) {
    error_ = std::current_exception();
  }
  done_ = true;
}

void BackgroundAdjustment::start(std::shared_ptr<const map::Snapshot> snapshot, MapId map,
                                 bool inertial) {
  cancel();
  cancel_ = done_ = false;
  running_ = true;
  if (!threaded_) {
    adjust(*snapshot, map, inertial);
    return;
  }
  thread_ = std::jthread([this, snapshot = std::move(snapshot), map, inertial] {
    lower_thread_priority();
    adjust(*snapshot, map, inertial);
  });
}

void BackgroundAdjustment::cancel() {
  cancel_ = true;
  if (thread_.joinable()) thread_.join();
  running_ = false;
  result_.reset();
  error_ = nullptr;
}

std::optional<map::LoopCorrection> BackgroundAdjustment::take() {
  if (thread_.joinable()) thread_.join();
  running_ = false;
  if (error_) std::rethrow_exception(std::exchange(error_, nullptr));
  return std::exchange(result_, std::nullopt);
}

}  // namespace fastloop::system
