#include "simulated_run.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "fastloop/eval/evaluation.hpp"

namespace fastloop::tests {

Calibration small_rig(sim::CameraKind kind) {
  Calibration c = sim::make_rig(kind);
  for (CameraCalibration& camera : c.cameras) {
    camera.camera.width /= 2;
    camera.camera.height /= 2;
    for (double* k : {&camera.camera.fx, &camera.camera.fy, &camera.camera.cx, &camera.camera.cy}) *k /= 2;
  }
  return c;
}

namespace {

sim::SequenceOptions sequence_options(sim::CameraKind kind, double seconds, std::uint64_t seed) {
  sim::SequenceOptions options;
  options.camera = kind;
  options.seconds = seconds;
  options.seed = seed;
  options.rig = small_rig(kind);
  return options;
}

}  // namespace

Recording::Recording(sim::CameraKind kind, double seconds, std::uint64_t seed)
    : sequence(sequence_options(kind, seconds, seed)) {
  for (std::size_t i = 0; i < sequence.size(); ++i) frames.push_back(sequence.frame(i));
}

void cover_lens(Recording& recording, double begin_s, double end_s) {
  for (FrameInput& f : recording.frames) {
    const double t = to_seconds(f.stamp_ns - recording.frames.front().stamp_ns);
    if (t < begin_s || t >= end_s) continue;
    std::fill(f.left.pixels.begin(), f.left.pixels.end(), 0);
    std::fill(f.right.pixels.begin(), f.right.pixels.end(), 0);
  }
}

system::SystemOptions small_options(system::Mode mode) {
  system::SystemOptions options;
  options.mode = mode;
  options.deterministic = true;
  options.orb.num_features = 600;
  return options;
}

void feed(system::System& system, const Recording& recording, const std::function<void(std::size_t)>& after_frame) {
  for (std::size_t i = 0; i < recording.frames.size(); ++i) {
    system.process(recording.frames[i]);
    if (after_frame) after_frame(i);
  }
  system.finish();
}

std::size_t count_tracked(const system::System& system) {
  return static_cast<std::size_t>(std::count_if(system.frames().begin(), system.frames().end(), [](const auto& f) {
    return f.state == tracking::State::kTracking;
  }));
}

std::size_t count_events(const system::System& system, const std::string& kind) {
  const auto events = system.events();
  return static_cast<std::size_t>(
      std::count_if(events.begin(), events.end(), [&](const auto& e) { return e.kind == kind; }));
}

double ate_m(const system::System& system, const sim::SimulatedSequence& truth, std::size_t begin, std::size_t end) {
  std::vector<io::StampedPose> reference, estimate;
  for (std::size_t i = begin; i < std::min(end, system.frames().size()); ++i) {
    const system::FrameRecord& f = system.frames()[i];
    const auto pose = system.T_world_body(f);
    if (!pose) continue;
    reference.push_back({f.stamp_ns, truth.ground_truth(f.stamp_ns).T_world_body});
    estimate.push_back({f.stamp_ns, *pose});
  }
  return eval::evaluate(reference, estimate, {}).ate_m.rmse;
}

double gravity_error_deg(const system::System& system, const sim::SimulatedSequence& truth, std::size_t frame) {
  const system::FrameRecord& f = system.frames().at(frame);
  const SE3 estimated = system.T_world_body(f).value(), exact = truth.ground_truth(f.stamp_ns).T_world_body;
  const Vector3d up = estimated.rotation * (exact.rotation.conjugate() * Vector3d::UnitZ());
  return std::atan2(up.head<2>().norm(), up.z()) * 180 / std::numbers::pi;
}

}  // namespace fastloop::tests
