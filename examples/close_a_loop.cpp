// Closes a loop without a SLAM front end: a host program that has keyframes of its own feeds them
// to loop::LoopCloser and applies the correction it returns. Here the keyframes are those of a
// simulated map whose last one has come back to where the run began.
#include <cstdio>

#include "fastloop/loop/loop_closer.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/sim/map_worlds.hpp"

using namespace fastloop;

/// Distance between where the last keyframe stands relative to the first and where it should.
double error_m(const sim::SimulatedMap& world) {
  const KeyframeId first(0), last = world.current;
  const SE3 mapped = world.map.T_world_body(first).inverse() * world.map.T_world_body(last);
  const SE3 truth = world.truth[first.value()].inverse() * world.truth[last.value()];
  return (mapped.translation - truth.translation).norm();
}

int main() {
  sim::MapWorldOptions options;
  options.keyframes = 150;
  options.features = 600;
  options.drift_scale = 5;
  sim::SimulatedMap world = sim::simulate_map(options);
  const double before = error_m(world);

  loop::LoopCloser closer(loop::LoopOptions{}, loop::Backend::kAuto, place::default_vocabulary());
  std::size_t closed = 0;
  for (std::uint32_t i = 0; i < world.map.keyframe_slots(); ++i) {
    // Readers get immutable snapshots; the map itself stays with its owner.
    const auto outcome = closer.process(*world.map.publish(), KeyframeId(i));
    if (!outcome.correction) continue;
    // All or nothing: a correction that does not fit is refused with the reason.
    const map::CorrectionOutcome applied = map::apply_correction(world.map, *outcome.correction);
    closer.conclude(applied);
    if (!applied.applied) {
      std::printf("keyframe %u: correction refused: %s\n", i, applied.reason.c_str());
      continue;
    }
    ++closed;
    std::printf(
        "keyframe %u sees the place of keyframe %u: %zu keyframes moved, %zu landmarks joined\n", i,
        outcome.correction->edge.a.value(), applied.moved, applied.merged);
  }
  const double after = error_m(world);
  std::printf("error of the last keyframe: %.3f m before, %.3f m after\n", before, after);
  return closed > 0 && after < 0.2 * before ? 0 : 1;
}
