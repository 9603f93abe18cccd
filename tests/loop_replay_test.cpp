#include "fastloop/loop/loop_replay.hpp"

#include <gtest/gtest.h>

#include <random>

#include "fastloop/core/error.hpp"
#include "fastloop/map/expectations_for_tests.hpp"
#include "simulated_loop.hpp"

/// Decisions replayed, and landmarks joined at once against one by one.
namespace fastloop::loop {
namespace {

using testing::Attempt;
using testing::small_world;

TEST(LoopReplay, DecidesAsTheRunDid) {
  for (const bool inertial : {false, true}) {
    sim::MapWorldOptions o = small_world(4);
    o.inertial = inertial;
    const Attempt run(o, Backend::kCpu);
    ASSERT_TRUE(run.outcome.correction.has_value());
    LoopRequest request;
    request.keyframe = run.world.current;
    request.inertial = inertial;
    std::vector<LoopReplay> replays;
    for (const Backend b : {Backend::kCpu, Backend::kReference})
      replays.emplace_back(run.world.map.publish(), parse_loop_request(to_json(request)), b);
    for (const ReplaySummary& s : repeat_replays(replays, 2)) {
      EXPECT_EQ(decision_digest(s.last.outcome), decision_digest(run.outcome));
      EXPECT_LT(largest_pose_difference(s.last.outcome, run.outcome), 1e-6);
      EXPECT_TRUE(s.last.applied.applied) << s.last.applied.reason;
      EXPECT_EQ(s.last.applied.merged, run.outcome.correction->merges.size());
    }
    EXPECT_EQ(pose_digest(replays[0].run().outcome), pose_digest(run.outcome));
  }
}

TEST(LoopReplay, TellsDifferentDecisionsApart) {
  const Attempt a(small_world(4), Backend::kCpu), b(small_world(5), Backend::kCpu);
  EXPECT_NE(decision_digest(a.outcome), decision_digest(b.outcome));
  EXPECT_NE(pose_digest(a.outcome), pose_digest(b.outcome));
  EXPECT_GT(largest_pose_difference(a.outcome, b.outcome), 1e-3);
}

TEST(LoopReplay, RefusesARequestThatDoesNotFitTheMap) {
  sim::MapWorldOptions o = small_world(4);
  o.features = 100;
  map::LoadedMap loaded{sim::simulate_map(o).map, {}};
  EXPECT_THROW(request_of(loaded, "f"), InputError);
  loaded.extras[kLoopRequestExtra] = "{}";
  EXPECT_THROW(request_of(loaded, "f"), InputError);
  loaded.extras[kLoopRequestExtra] = R"({"keyframe": 100000})";
  EXPECT_THROW(request_of(loaded, "f"), InputError);
  loaded.extras[kLoopRequestExtra] = R"({"keyframe": 100})";
  EXPECT_EQ(request_of(loaded, "f").keyframe, KeyframeId(100));
}

TEST(LandmarkFusion, AtOnceIsAsOneByOne) {
  sim::MapWorldOptions o = small_world(8);
  o.keyframes = 80;
  o.features = 120;
  const map::Map before = sim::simulate_map(o).map;
  std::mt19937 random(3);
  for (int trial = 0; trial < 40; ++trial) {
    // Neighbouring ids are seen by the same keyframes: refused observations, chains, repetitions.
    const auto near = static_cast<std::uint32_t>(random() % (before.landmark_slots() - 60));
    const auto pick = [&](std::uint32_t range) {
      return LandmarkId((near + static_cast<std::uint32_t>(random() % range)) %
                        static_cast<std::uint32_t>(before.landmark_slots()));
    };
    std::vector<map::LandmarkMerge> merges;
    std::vector<map::NewObservation> observations;
    for (int i = 0; i < 50; ++i) {
      const std::uint32_t range = trial % 2 ? 60 : 2000;
      merges.push_back({pick(range), pick(range)});
      const KeyframeId k(static_cast<std::uint32_t>(random() % before.keyframe_slots()));
      observations.push_back({pick(range), k, static_cast<std::uint32_t>(random() % 100)});
    }
    map::Map one_by_one(before), at_once(before);
    const auto a = one_by_one.fuse_landmarks(Executor::reference(), merges, observations);
    const auto b = at_once.fuse_landmarks(Executor::cpu(), merges, observations);
    EXPECT_EQ(a.merged, b.merged);
    EXPECT_EQ(a.observed, b.observed);
    EXPECT_GT(a.merged, 10u);
    map::testing::expect_same_landmarks(one_by_one, at_once);
    EXPECT_EQ(at_once.find_inconsistency(), std::nullopt);
  }
}

}  // namespace
}  // namespace fastloop::loop
