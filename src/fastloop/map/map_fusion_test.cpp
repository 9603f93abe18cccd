#include <gtest/gtest.h>

#include "fastloop/map/expectations_for_tests.hpp"
#include "fastloop/map/loop_map_for_tests.hpp"

/// Joining many landmarks at once: both executors alike on anything that may be asked for.
namespace fastloop::map {
namespace {

using testing::loop_map_options;
using testing::LoopMap;

TEST(FuseLandmarks, BothExecutorsAlike) {
  std::size_t merged = 0, observed = 0, refused = 0;
  for (unsigned seed = 0; seed < 240; ++seed) {
    SCOPED_TRACE(seed);
    const LoopMap loop(seed, loop_map_options(seed));
    std::mt19937 rng(seed);
    const auto slots = static_cast<std::uint32_t>(loop.map().landmark_slots());
    const auto keyframes = static_cast<std::uint32_t>(loop.map().keyframe_slots());
    // Chains, repetitions, a landmark with itself, keyframes that see both, taken keypoints.
    const std::uint32_t range = seed % 4 == 0 ? std::min(slots, 6u) : slots;
    std::vector<LandmarkMerge> merges;
    std::vector<NewObservation> observations;
    const unsigned count = slots > 0 ? rng() % 60 : 0;
    for (unsigned i = 0; i < count; ++i) {
      merges.push_back({LandmarkId(rng() % range), LandmarkId(rng() % range)});
      const KeyframeId k(rng() % keyframes);
      const auto keypoints = static_cast<std::uint32_t>(loop.map().keyframe(k).landmarks.size());
      if (keypoints == 0) continue;
      const auto keypoint = static_cast<std::uint32_t>(rng() % keypoints);
      observations.push_back({LandmarkId(rng() % range), k, keypoint});
    }
    Map one_by_one(loop.map()), at_once(loop.map());
    if (seed % 5 == 0 && slots > 0)
      for (Map* m : {&one_by_one, &at_once}) m->remove_landmark(LandmarkId(seed % slots));
    const auto a = one_by_one.fuse_landmarks(Executor::reference(), merges, observations);
    const auto b = at_once.fuse_landmarks(Executor::cpu(), merges, observations);
    EXPECT_EQ(a.merged, b.merged);
    EXPECT_EQ(a.observed, b.observed);
    testing::expect_same_landmarks(one_by_one, at_once);
    EXPECT_EQ(at_once.find_inconsistency(), std::nullopt);
    merged += b.merged;
    observed += b.observed;
    refused += observations.size() - b.observed;
  }
  EXPECT_GT(merged, 1000u);
  EXPECT_GT(observed, 300u);
  EXPECT_GT(refused, 1000u);
}

TEST(FuseLandmarks, TrueDuplicatesBecomeOne) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    testing::LoopMapOptions o;
    o.fisheye = seed % 2;
    const LoopMap loop(seed, o);
    // The first landmark of a point is that of the early keyframes.
    std::vector<LandmarkId> first(loop.world.points.size());
    std::vector<LandmarkMerge> merges;
    for (std::uint32_t l = 0; l < loop.point_of.size(); ++l) {
      LandmarkId& kept = first[static_cast<std::size_t>(loop.point_of[l])];
      if (kept.valid())
        merges.push_back({LandmarkId(l), kept});
      else
        kept = LandmarkId(l);
    }
    ASSERT_GT(merges.size(), 10u);
    Map map(loop.map());
    const auto outcome = map.fuse_landmarks(Executor::cpu(), merges, {});
    EXPECT_EQ(outcome.merged, merges.size());
    EXPECT_EQ(map.num_landmarks() + merges.size(), loop.map().num_landmarks());
    for (const LandmarkMerge& m : merges) {
      EXPECT_EQ(map.resolve(m.loser), m.winner);
      EXPECT_EQ(map.landmark(m.winner).observations.size(),
                loop.map().landmark(m.winner).observations.size() +
                    loop.map().landmark(m.loser).observations.size());
    }
    EXPECT_EQ(map.find_inconsistency(), std::nullopt);
  }
}

}  // namespace
}  // namespace fastloop::map
