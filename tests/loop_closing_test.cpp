#include <gtest/gtest.h>

#include "fastloop/loop/loop_closer.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/sim/map_worlds.hpp"

/// Loop closing on simulated maps: no images, no front end, known truth.
namespace fastloop::loop {
namespace {

struct Attempt {
  sim::SimulatedMap world;
  LoopCloser closer;
  LoopCloser::Outcome outcome;

  static LoopOptions options_for(const sim::MapWorldOptions& o) {
    LoopOptions options;
    options.inertial = o.inertial;
    return options;
  }
  Attempt(const sim::MapWorldOptions& o, Backend backend)
      : world(sim::simulate_map(o)),
        closer(options_for(o), backend, place::default_vocabulary()) {
    const auto snapshot = world.map.publish();
    for (std::uint32_t i = 0; i < snapshot->keyframe_slots(); ++i)
      if (KeyframeId(i) != world.current) closer.add(*snapshot, KeyframeId(i));
    outcome = closer.process(*snapshot, world.current);
  }
};

std::string describe(const LoopReport& r) {
  std::string text = std::string(to_string(r.verdict)) + " " + r.reason + "\n";
  for (const CandidateReport& c : r.candidates) {
    text += "  keyframe " + std::to_string(c.keyframe.value()) + " words " +
            std::to_string(c.shared_words) + " matches " + std::to_string(c.descriptor_matches) +
            ": " + to_string(c.verdict) + " " + c.reason + "\n";
    for (const GateReading& g : c.gates)
      text += "    " + g.gate + " " + std::to_string(g.value) + " / " + std::to_string(g.threshold) + "\n";
  }
  for (const auto& [stage, ms] : r.times_ms) text += "  " + stage + " " + std::to_string(ms) + " ms\n";
  return text;
}

class SimulatedLoop : public ::testing::TestWithParam<std::tuple<bool, bool>> {};

TEST_P(SimulatedLoop, IsClosedWhereTheTruthSays) {
  sim::MapWorldOptions o;
  o.keyframes = 150;
  o.seed = 3;
  std::tie(o.fisheye, o.inertial) = GetParam();
  Attempt run(o, Backend::kCpu);
  SCOPED_TRACE(describe(run.outcome.report));
  ASSERT_TRUE(run.outcome.correction.has_value());
  map::LoopCorrection& c = *run.outcome.correction;
  const SE3 T_a_b = run.world.truth[c.edge.a.value()].inverse() * run.world.truth[c.edge.b.value()];
  EXPECT_LT((c.edge.T_a_b.translation - T_a_b.translation).norm(), 0.1);
  EXPECT_LT(angle_between(c.edge.T_a_b, T_a_b), 0.02);
  EXPECT_GT(c.merges.size(), 50u);

  const auto outcome = map::apply_correction(run.world.map, c);
  ASSERT_TRUE(outcome.applied) << outcome.reason;
  EXPECT_EQ(run.world.map.find_inconsistency(), std::nullopt);
  const SE3 now = run.world.map.T_world_body(c.edge.a).inverse() * run.world.map.T_world_body(c.edge.b);
  EXPECT_LT((now.translation - T_a_b.translation).norm(), 0.1);
  std::cerr << describe(run.outcome.report);
}
INSTANTIATE_TEST_SUITE_P(Cameras, SimulatedLoop,
                         ::testing::Combine(::testing::Bool(), ::testing::Bool()));

}  // namespace
}  // namespace fastloop::loop
