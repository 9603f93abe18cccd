#include "fastloop/mapping/culling.hpp"

#include <gtest/gtest.h>

#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::mapping {
namespace {

using map::testing::pose_at;
using map::testing::SyntheticMap;
using map::testing::SyntheticWorld;

/// Thirty keyframes of one place, five each second, all seeing the same.
class Culling : public ::testing::Test {
 protected:
  Culling() : world(400, {5, 5, 2.5}, 1), m(world) {
    std::mt19937 rng(1);
    for (int i = 0; i < 30; ++i) {
      const KeyframeId k = m.add(pose_at({0, -0.002 * i, 0}, 0), {.noise_px = 0.1}, rng);
      if (i == 0) continue;
      const Nanoseconds begin = (i - 1) * m.interval_ns, end = i * m.interval_ns;
      const auto samples = synthetic::regular_samples(begin, end, 10'000'000);
      m.map.set_imu(k, std::make_shared<const PreintegratedImu>(samples, begin, end, ImuBias{},
                                                                ImuCalibration{}));
    }
    options.close_depth_baselines = 100;
  }
  int cull_until_nothing_is_left_to_cull(bool inertial) {
    int all = 0;
    for (;;) {
      const std::size_t before = m.map.num_keyframes();
      const int removed = cull_keyframes(m.map, KeyframeId(29), inertial, options);
      EXPECT_EQ(m.map.num_keyframes() + static_cast<std::size_t>(removed), before);
      if (removed == 0) return all;
      all += removed;
    }
  }
  const SyntheticWorld world;
  SyntheticMap m;
  MappingOptions options;
};

TEST_F(Culling, LeavesFirstAndLastAndEnoughObservers) {
  EXPECT_GT(cull_until_nothing_is_left_to_cull(false), 20);
  EXPECT_TRUE(m.map.contains(KeyframeId(0)));
  EXPECT_TRUE(m.map.contains(KeyframeId(29)));
  EXPECT_GE(m.map.num_keyframes(), 3u);
  EXPECT_FALSE(m.map.find_inconsistency());
}

TEST_F(Culling, WaitsForTheImuToBeInitialised) {
  options.use_imu = true;
  EXPECT_EQ(cull_keyframes(m.map, KeyframeId(29), false, options), 0);
}

TEST_F(Culling, HonoursTheImuGapAndTheRecentKeyframes) {
  options.use_imu = true;
  options.max_imu_gap_s = 1;
  EXPECT_GT(cull_until_nothing_is_left_to_cull(true), 5);
  for (std::uint32_t k = 18; k < 30; ++k) EXPECT_TRUE(m.map.contains(KeyframeId(k))) << k;
  for (KeyframeId k(29); m.map.keyframe(k).previous.valid(); k = m.map.keyframe(k).previous) {
    const auto& imu = m.map.keyframe(k).imu_from_previous;
    ASSERT_TRUE(imu);
    EXPECT_LT(imu->duration_s(), 1);
    EXPECT_NEAR(imu->duration_s(),
                to_seconds(m.map.keyframe(k).data->stamp_ns) -
                    to_seconds(m.map.keyframe(m.map.keyframe(k).previous).data->stamp_ns),
                1e-9);
  }
  EXPECT_FALSE(m.map.find_inconsistency());
}

TEST_F(Culling, KeepsKeyframesOfWhichNothingCanBeJudged) {
  options.close_depth_baselines = 0.1;  // every point is far
  EXPECT_EQ(cull_keyframes(m.map, KeyframeId(29), false, options), 0);
}

TEST(CullKeyframes, KeepsKeyframesWithAViewOfTheirOwn) {
  std::mt19937 rng(2);
  const SyntheticWorld world(1500, {5, 5, 2.5}, 2);
  SyntheticMap m(world);
  for (int i = 0; i < 8; ++i) m.add(pose_at({0, 0, 0}, 0.5 * i), {}, rng);
  MappingOptions options;
  options.close_depth_baselines = 100;
  EXPECT_EQ(cull_keyframes(m.map, KeyframeId(7), false, options), 0);
}

}  // namespace
}  // namespace fastloop::mapping
