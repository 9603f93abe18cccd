#include <atomic>
#include <thread>

#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/matching/descriptor_pairs_for_tests.hpp"
#include "fastloop/matching/device_for_tests.hpp"
#include "fastloop/matching/expectations_for_tests.hpp"
#include "fastloop/matching/resident_store.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::expect_equal;
using testing::finish;
using testing::OnDevice;
using testing::random_scene;
using testing::rule;
using testing::run;
using testing::Scene;
using testing::SceneSize;

class DeviceSearch : public OnDevice {
 protected:
  int expect_parity(const Scene& scene, const ProjectionSearchOptions& options) {
    const auto expected = run(Executor::reference(), scene, options);
    const auto found = run(device(), scene, options);
    int matches = 0;
    for (std::size_t t = 0; t < expected.size(); ++t) {
      expect_equal(expected[t], found[t]);
      matches += expected[t].count;
    }
    return matches;
  }
};

TEST_F(DeviceSearch, EqualsReferenceWithBothCamerasAndAllRules) {
  int matches = 0, situations = 0;
  for (unsigned seed = 0; seed < 240; ++seed) {
    SCOPED_TRACE(seed);
    SceneSize size;
    size.landmarks = seed % 8 == 0 ? 1 : 20 + 7 * static_cast<int>(seed % 41);
    size.targets = 1 + static_cast<int>(seed % 3);
    size.crowding = seed % 5 == 0 ? 0.6 : 0;  // cells with more than 100 keypoints
    const Scene scene = random_scene(seed, seed % 2 == 1, size);
    matches += expect_parity(scene, rule(static_cast<int>(seed / 2 % 4)));
    situations += size.targets;
  }
  EXPECT_GE(situations, 200);
  EXPECT_GT(matches, 2000);
}

/// Beyond 4,100 landmarks, 40 targets and 20 keypoints in a cell.
TEST_F(DeviceSearch, EqualsReferenceOnManyTargets) {
  SceneSize size;
  size.landmarks = 5000;
  size.targets = 60;
  size.clutter = 300;
  for (const bool fisheye : {false, true})
    for (const double crowding : {0.0, 0.2}) {
      size.crowding = crowding;
      EXPECT_GT(expect_parity(random_scene(77, fisheye, size), rule(1)), 500);
    }
}

TEST_F(DeviceSearch, EmptyInputs) {
  SceneSize none;
  none.landmarks = 0;
  const Scene scene = random_scene(1, false, none);
  expect_parity(scene, {});
  search_by_projection(device(), scene.rig, scene.scales, {}, scene.landmarks.view(), {}, {});
  EXPECT_EQ(find_by_projection(device(), scene.rig, scene.scales, {}, {}).size(), 0u);
  Scene blind = random_scene(1, false, {});
  for (FeatureSet& f : blind.features) {
    f = FeatureSet();
    finish(f, blind.rig.left);
  }
  blind.blocked.assign(blind.features.size(), {});
  expect_parity(blind, {});
}

/// Several sets of landmarks, each with some targets, one of them with none and one set empty.
TEST_F(DeviceSearch, JobsOfOneCallEqualSearchesOneByOne) {
  std::vector<Scene> scenes;
  for (unsigned seed = 0; seed < 5; ++seed) {
    SceneSize size;
    size.landmarks = seed == 3 ? 0 : 100 + 300 * static_cast<int>(seed);
    size.targets = seed == 2 ? 0 : 1 + static_cast<int>(seed);
    scenes.push_back(random_scene(seed, false, size));
  }
  std::vector<std::vector<SearchTarget>> targets;
  for (const Scene& s : scenes) targets.push_back(s.targets());
  std::vector<ProjectionJob> jobs;
  for (std::size_t s = 0; s < scenes.size(); ++s)
    jobs.push_back({scenes[s].landmarks.view(), targets[s]});
  const auto all = [&](const Executor& executor) {
    return find_by_projection(executor, scenes[0].rig, scenes[0].scales, jobs, rule(1));
  };
  const CudaCounters before = session_->counters();
  const MatchLists on_device = all(device());
  EXPECT_EQ(session_->counters().launches - before.launches, 1u);
  EXPECT_EQ(session_->counters().synchronizations - before.synchronizations, 1u);
  const MatchLists expected = all(Executor::reference());
  EXPECT_EQ(on_device.start, expected.start);
  EXPECT_EQ(on_device.matches, expected.matches);
  EXPECT_GT(expected.matches.size(), 50u);
}

TEST_F(DeviceSearch, SteadyStateAllocatesNothing) {
  const Scene scene = random_scene(5, true, {});
  expect_parity(scene, rule(2));
  const CudaCounters before = session_->counters();
  for (int i = 0; i < 5; ++i) expect_parity(scene, rule(2));
  EXPECT_EQ(session_->counters().allocations, before.allocations);
}

TEST_F(DeviceSearch, ThreadsShareASessionWhileKeyframesArrive) {
  std::vector<Scene> scenes;
  std::vector<std::vector<ProjectionMatches>> expected;
  for (unsigned seed = 0; seed < 4; ++seed) {
    scenes.push_back(random_scene(seed, seed % 2 == 1, {}));
    expected.push_back(run(Executor::reference(), scenes.back(), rule(1)));
  }
  std::atomic<int> wrong{0};
  std::vector<std::thread> threads;
  for (std::size_t s = 0; s < scenes.size(); ++s)
    threads.emplace_back([&, s] {
      for (int i = 0; i < 30; ++i) {
        const auto found = run(device(), scenes[s], rule(1));
        for (std::size_t t = 0; t < found.size(); ++t)
          wrong += found[t].keypoint != expected[s][t].keypoint;
      }
    });
  for (int i = 0; i < 200; ++i)
    make_resident(device(), std::make_shared<const FeatureSet>(scenes[0].features[0]));
  for (std::thread& t : threads) t.join();
  EXPECT_EQ(wrong, 0);
}

class DeviceMatching : public OnDevice {};

TEST_F(DeviceMatching, EqualsReferenceWithAndWithoutGroups) {
  int matches = 0;
  for (unsigned seed = 0; seed < 200; ++seed) {
    const auto [a, b] = testing::random_pair(seed);
    DescriptorMatchOptions options;
    options.best_to_second = seed % 4 == 0 ? 1 : 0.9f;
    options.check_rotation = seed % 2 == 0;
    for (const bool grouped : {false, true}) {
      const auto expected =
          match_descriptors(Executor::reference(), a.view(grouped), b.view(grouped), options);
      ASSERT_EQ(match_descriptors(device(), a.view(grouped), b.view(grouped), options), expected)
          << seed << " " << grouped;
      for (const int k : expected) matches += k != kNoMatch;
    }
  }
  EXPECT_GT(matches, 1000);
}

TEST_F(DeviceMatching, ManyImagesInOneLaunch) {
  std::vector<testing::Side> sides;
  for (unsigned seed = 1; seed < 70; ++seed) {
    auto [a, b] = testing::random_pair(seed);
    sides.push_back(std::move(a));
    sides.push_back(std::move(b));
  }
  std::vector<MatchSide> seconds;
  for (std::size_t i = 1; i < sides.size(); ++i) seconds.push_back(sides[i].view(i % 7 != 0));
  const auto expected = match_descriptors(Executor::reference(), sides[0].view(true), seconds);
  for (int round = 0; round < 3; ++round) {
    const CudaCounters before = session_->counters();
    EXPECT_EQ(match_descriptors(device(), sides[0].view(true), seconds), expected);
    EXPECT_EQ(session_->counters().launches - before.launches, 2u);  // with groups, without
    // From the second round on the groups are known not to change, and stay on the device. While
    // they go there, an upload may wait for a staging buffer of an earlier one.
    EXPECT_LE(session_->counters().synchronizations - before.synchronizations,
              round == 1 ? sides.size() + 1 : 1u);
    for (const testing::Side& side : sides) side.groups.id.assign();
  }
  EXPECT_TRUE(match_descriptors(device(), sides[0].view(true), std::span<const MatchSide>()).empty());
}

/// Thousands of vocabulary nodes with few keypoints each, and one with most of them.
TEST_F(DeviceMatching, ManySmallGroupsAndOneLarge) {
  std::mt19937 rng(8);
  std::vector<testing::Side> sides(2);
  for (testing::Side& s : sides) {
    for (int i = 0; i < 3000; ++i) {
      testing::add_keypoint(s.features, rng() % 700, rng() % 400, static_cast<int>(rng() % 8),
                            testing::random_descriptor(rng));
      s.node.push_back(i % 3 == 0 ? 77u : 1 + rng() % 1500);
    }
    finish(s.features, testing::pinhole_rig().left);
    s.group();
  }
  DescriptorMatchOptions options;
  options.max_distance = 120;
  options.best_to_second = 1;
  const auto expected =
      match_descriptors(Executor::reference(), sides[0].view(true), sides[1].view(true), options);
  EXPECT_EQ(match_descriptors(device(), sides[0].view(true), sides[1].view(true), options),
            expected);
  EXPECT_GT(std::count_if(expected.begin(), expected.end(), [](int k) { return k >= 0; }), 300);
}

class DeviceFailure : public OnDevice {};

/// Whatever call of the device fails: results are those of the CPU, and the next step is tried on
/// the device again.
TEST_F(DeviceFailure, OutOfMemoryLosesNothing) {
  const Scene scene = random_scene(9, false, {});
  const auto expected = run(Executor::reference(), scene, rule(1));
  const auto [a, b] = testing::random_pair(3);
  const auto matched = match_descriptors(Executor::reference(), a.view(true), b.view(true));
  for (int n = 1; n < 20; ++n) {
    SCOPED_TRACE(n);
    session_->inject_failure(n, false);
    const auto found = run(device(), scene, rule(1));
    for (std::size_t t = 0; t < expected.size(); ++t) expect_equal(expected[t], found[t]);
    session_->inject_failure(n, false);
    EXPECT_EQ(match_descriptors(device(), a.view(true), b.view(true)), matched);
    session_->inject_failure(0, false);
    EXPECT_TRUE(session_->usable());
  }
  const CudaCounters before = session_->counters();
  run(device(), scene, rule(1));
  EXPECT_EQ(session_->counters().launches, before.launches + 1);
}

TEST_F(DeviceFailure, LostDeviceIsNotAskedAgain) {
  const Scene scene = random_scene(9, false, {});
  const auto expected = run(Executor::reference(), scene, rule(1));
  session_->inject_failure(4, true);
  for (int i = 0; i < 3; ++i) {
    const auto found = run(device(), scene, rule(1));
    for (std::size_t t = 0; t < expected.size(); ++t) expect_equal(expected[t], found[t]);
    EXPECT_FALSE(session_->usable());
  }
  EXPECT_EQ(make_resident(device(), scene.landmarks.view()), nullptr);
  make_resident(device(), std::make_shared<const FeatureSet>(scene.features[0]));
  EXPECT_EQ(session_->counters().launches, 0u);
}

}  // namespace
}  // namespace fastloop::matching
