#include <gtest/gtest.h>

#include <limits>

#include "simulated_loop.hpp"

/// Loop closing on simulated maps against their truth, and the two back ends against each other.
namespace fastloop::loop {
namespace {

using testing::Attempt;
using testing::describe;
using testing::small_world;
using testing::true_edge;

class SimulatedLoop : public ::testing::TestWithParam<std::tuple<bool, bool>> {};

TEST_P(SimulatedLoop, IsClosedWhereTheTruthSays) {
  sim::MapWorldOptions o = small_world();
  std::tie(o.fisheye, o.inertial) = GetParam();
  Attempt a(o, Backend::kCpu);
  SCOPED_TRACE(describe(a.outcome.report));
  ASSERT_TRUE(a.outcome.correction.has_value());
  const map::LoopCorrection& c = *a.outcome.correction;
  const SE3 truth = true_edge(a.world, c.edge);
  EXPECT_LT((c.edge.T_a_b.translation - truth.translation).norm(), 0.1);
  EXPECT_LT(angle_between(c.edge.T_a_b, truth), 0.02);

  // Joined landmarks show the same point of the world.
  std::size_t right = 0;
  for (const map::LandmarkMerge& m : c.merges)
    right += a.world.point_of[m.loser.value()] == a.world.point_of[m.winner.value()];
  EXPECT_GT(c.merges.size(), 50u);
  EXPECT_GE(right, c.merges.size() * 98 / 100);

  const auto outcome = map::apply_correction(a.world.map, c);
  ASSERT_TRUE(outcome.applied) << outcome.reason;
  EXPECT_EQ(outcome.merged, c.merges.size());
  EXPECT_EQ(outcome.observed, c.observations.size());
  EXPECT_EQ(a.world.map.find_inconsistency(), std::nullopt);
  EXPECT_EQ(a.world.map.loop_edges().size(), 1u);
  const SE3 now =
      a.world.map.T_world_body(c.edge.a).inverse() * a.world.map.T_world_body(c.edge.b);
  EXPECT_LT((now.translation - truth.translation).norm(), 0.1);
}
INSTANTIATE_TEST_SUITE_P(Cameras, SimulatedLoop,
                         ::testing::Combine(::testing::Bool(), ::testing::Bool()));

TEST(SimulatedLoop, ErrorsOfThePosesShrink) {
  sim::MapWorldOptions o = small_world(5);
  o.drift_scale = 3;
  Attempt a(o, Backend::kCpu);
  ASSERT_TRUE(a.outcome.correction.has_value()) << describe(a.outcome.report);
  // Errors after fixing the first keyframe, where truth and map begin together.
  const auto error = [&](KeyframeId id) {
    const std::vector<SE3>& t = a.world.truth;
    const map::Map& map = a.world.map;
    const SE3 from_first = t[0].inverse() * t[id.value()];
    const SE3 estimated = map.T_world_body(KeyframeId(0)).inverse() * map.T_world_body(id);
    return (from_first.translation - estimated.translation).norm();
  };
  const auto sum = [&] {
    double total = 0;
    for (std::uint32_t i = 0; i < a.world.map.keyframe_slots(); ++i) total += error(KeyframeId(i));
    return total;
  };
  const double last_before = error(a.world.current), sum_before = sum();
  ASSERT_TRUE(map::apply_correction(a.world.map, *a.outcome.correction).applied);
  EXPECT_LT(error(a.world.current), 0.3 * last_before);
  EXPECT_LT(sum(), 0.6 * sum_before);
}

TEST(SimulatedLoop, IsFoundOnlyOnce) {
  Attempt a(small_world(), Backend::kCpu);
  ASSERT_TRUE(a.outcome.correction.has_value());
  a.closer.conclude(map::apply_correction(a.world.map, *a.outcome.correction));
  const auto again = a.closer.process(*a.world.map.publish(), a.world.current);
  EXPECT_FALSE(again.correction.has_value()) << describe(again.report);
}

TEST(MapMerge, JoinsTwoMapsOfOnePlace) {
  for (const bool inertial : {false, true}) {
    sim::MapWorldOptions o = small_world(11);
    o.two_maps = true;
    o.inertial = inertial;
    Attempt a(o, Backend::kCpu);
    SCOPED_TRACE(describe(a.outcome.report));
    ASSERT_TRUE(a.outcome.correction.has_value());
    const map::LoopCorrection& c = *a.outcome.correction;
    EXPECT_EQ(c.kind, map::LoopCorrection::Kind::kMerge);
    const auto outcome = map::apply_correction(a.world.map, c);
    ASSERT_TRUE(outcome.applied) << outcome.reason;
    EXPECT_EQ(a.world.map.find_inconsistency(), std::nullopt);
    EXPECT_EQ(a.world.map.map_info(c.map).num_keyframes, a.world.map.num_keyframes());
    EXPECT_EQ(a.world.map.resolve(c.merged), c.map);
    const SE3 truth = true_edge(a.world, c.edge);
    const SE3 now =
        a.world.map.T_world_body(c.edge.a).inverse() * a.world.map.T_world_body(c.edge.b);
    EXPECT_LT((now.translation - truth.translation).norm(), 0.1);
  }
}

TEST(MapMerge, CanBeSwitchedOff) {
  sim::MapWorldOptions o = small_world(11);
  o.two_maps = true;
  Attempt a(o, Backend::kCpu, [](LoopOptions& options) { options.merge_maps = false; });
  EXPECT_FALSE(a.outcome.correction.has_value());
  EXPECT_TRUE(a.outcome.report.candidates.empty());
}

/// Decisions and correction of the reference and another back end on one world.
void expect_parity(const sim::MapWorldOptions& o, Backend backend) {
  Attempt r(o, Backend::kReference), c(o, backend);
  SCOPED_TRACE(describe(r.outcome.report) + describe(c.outcome.report));
  const LoopReport &a = r.outcome.report, &b = c.outcome.report;
  EXPECT_EQ(a.verdict, b.verdict);
  ASSERT_EQ(a.candidates.size(), b.candidates.size());
  for (std::size_t i = 0; i < a.candidates.size(); ++i) {
    const CandidateReport &x = a.candidates[i], &y = b.candidates[i];
    EXPECT_EQ(x.keyframe, y.keyframe);
    EXPECT_EQ(x.shared_words, y.shared_words);
    EXPECT_EQ(x.score, y.score);
    EXPECT_EQ(x.descriptor_matches, y.descriptor_matches);
    EXPECT_EQ(x.reason, y.reason);
    ASSERT_EQ(x.gates.size(), y.gates.size());
    for (std::size_t g = 0; g < x.gates.size(); ++g) {
      EXPECT_EQ(x.gates[g].gate, y.gates[g].gate);
      EXPECT_NEAR(x.gates[g].value, y.gates[g].value, 1e-9);
    }
  }
  ASSERT_EQ(r.outcome.correction.has_value(), c.outcome.correction.has_value());
  if (!r.outcome.correction) return;
  const map::LoopCorrection &p = *r.outcome.correction, &q = *c.outcome.correction;
  ASSERT_EQ(p.merges.size(), q.merges.size());
  for (std::size_t i = 0; i < p.merges.size(); ++i) {
    EXPECT_EQ(p.merges[i].loser, q.merges[i].loser);
    EXPECT_EQ(p.merges[i].winner, q.merges[i].winner);
  }
  ASSERT_EQ(p.observations.size(), q.observations.size());
  for (std::size_t i = 0; i < p.observations.size(); ++i) {
    EXPECT_EQ(p.observations[i].landmark, q.observations[i].landmark);
    EXPECT_EQ(p.observations[i].keyframe, q.observations[i].keyframe);
    EXPECT_EQ(p.observations[i].keypoint, q.observations[i].keypoint);
  }
  ASSERT_EQ(p.states.size(), q.states.size());
  for (std::size_t i = 0; i < p.states.size(); ++i) {
    EXPECT_EQ(p.states[i].keyframe, q.states[i].keyframe);
    const SE3 &x = p.states[i].after.T_world_body, &y = q.states[i].after.T_world_body;
    EXPECT_LT((x.translation - y.translation).norm(), 1e-6);
    EXPECT_LT(angle_between(x, y), 1e-6);
  }
}

TEST(BackendParity, SameDecisionsAndCorrections) {
  for (std::uint64_t seed = 1; seed <= 8; ++seed) {
    sim::MapWorldOptions o = small_world(seed);
    o.fisheye = seed % 2;
    o.inertial = seed % 4 >= 2;
    o.two_maps = seed % 5 == 0;
    if (seed % 3 == 0) {
      o.loops = 1;
      o.keyframes = 200;
    }
    o.noise_px = seed == 7 ? 3 : 0.5;
    SCOPED_TRACE("seed " + std::to_string(seed));
    for (const Backend backend : testing::parallel_backends()) expect_parity(o, backend);
  }
}

}  // namespace
}  // namespace fastloop::loop
