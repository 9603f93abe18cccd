#include <gtest/gtest.h>

#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/mapping/inertial_alignment.hpp"
#include "fastloop/mapping/local_adjustment.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::mapping {
namespace {

using map::testing::normal_vector;
using map::testing::pose_at;
using map::testing::SyntheticMap;
using map::testing::SyntheticWorld;

class LocalAdjustment : public ::testing::Test {
 protected:
  LocalAdjustment() : world(1000, {5, 5, 2.5}, 1), m(world) {
    for (int i = 0; i < 8; ++i)
      m.add(pose_at({0.05 * i, -0.2 * i, 0}, 0.03 * i), {.noise_px = 0, .flipped_bits = 0}, rng);
    options.adjustment_iterations = 20;
  }
  void disturb(double angle, double distance) {
    for (std::uint32_t k = 1; k < 8; ++k) {
      NavState s = m.map.keyframe(KeyframeId(k)).state;
      Vector6d d;
      d << normal_vector(rng, angle), normal_vector(rng, distance);
      s.T_world_body = s.T_world_body.retract(d);
      m.map.set_state(KeyframeId(k), s);
    }
    for (std::uint32_t l = 0; l < m.map.landmark_slots(); ++l)
      m.map.set_p_world(LandmarkId(l), m.map.p_world(LandmarkId(l)) + normal_vector(rng, distance));
  }
  double largest_pose_error() const {
    double worst = 0;
    for (std::uint32_t k = 0; k < 8; ++k)
      worst = std::max(worst, m.truth[k].local(m.map.T_world_body(KeyframeId(k))).norm());
    return worst;
  }
  std::mt19937 rng{1};
  const SyntheticWorld world;
  SyntheticMap m;
  MappingOptions options;
};

TEST_F(LocalAdjustment, BringsPosesAndPointsBackToTheTruth) {
  disturb(0.003, 0.015);
  ASSERT_GT(largest_pose_error(), 0.01);
  const auto result = adjust_locally(m.map, KeyframeId(7), false, options, nullptr);
  ASSERT_TRUE(result.usable) << result.reason;
  EXPECT_LT(result.final_cost, 1e-3 * result.initial_cost);
  EXPECT_LT(largest_pose_error(), 2e-3);
  std::vector<double> errors;
  for (std::size_t p = 0; p < world.points.size(); ++p)
    if (m.landmark_of[p].valid() && m.map.contains(m.landmark_of[p]))
      errors.push_back((m.map.p_world(m.landmark_of[p]) - world.points[p]).norm());
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 5e-3);
  EXPECT_FALSE(m.map.find_inconsistency());
}

TEST_F(LocalAdjustment, RemovesWrongObservations) {
  // Landmark a is also "seen" where another point is.
  const auto& landmarks = m.map.keyframe(KeyframeId(5)).landmarks;
  std::vector<std::pair<LandmarkId, std::uint32_t>> wrong;
  for (std::uint32_t i = 0; i + 1 < landmarks.size() && wrong.size() < 5; i += 20) {
    const LandmarkId a = landmarks[i], b = landmarks[i + 1];
    if (!a.valid() || !b.valid() || m.map.landmark(a).observations.size() < 4 ||
        m.map.landmark(b).observations.size() < 4)
      continue;
    m.map.remove_observation(a, KeyframeId(5));
    m.map.remove_observation(b, KeyframeId(5));
    ASSERT_TRUE(m.map.add_observation(a, KeyframeId(5), i + 1));
    wrong.emplace_back(a, i + 1);
  }
  ASSERT_GE(wrong.size(), 3u);
  ASSERT_TRUE(adjust_locally(m.map, KeyframeId(7), false, options, nullptr).usable);
  for (const auto& [landmark, keypoint] : wrong) {
    EXPECT_TRUE(m.map.contains(landmark));
    EXPECT_FALSE(m.map.keyframe(KeyframeId(5)).landmarks[keypoint].valid());
  }
  EXPECT_LT(largest_pose_error(), 2e-3);
  EXPECT_FALSE(m.map.find_inconsistency());
}

TEST_F(LocalAdjustment, LeavesTheMapAloneWhenTheResultIsUnusable) {
  NavState broken = m.map.keyframe(KeyframeId(4)).state;
  broken.T_world_body.translation.x() = std::numeric_limits<double>::quiet_NaN();
  m.map.set_state(KeyframeId(4), broken);
  const auto before = m.map.version();
  const auto result = adjust_locally(m.map, KeyframeId(7), false, options, nullptr);
  EXPECT_FALSE(result.usable);
  EXPECT_FALSE(result.reason.empty());
  EXPECT_EQ(m.map.version(), before);
}

TEST_F(LocalAdjustment, AppliesNothingOfAnUnusableResult) {
  MapAdjustment adjustment(m.map, {KeyframeId(6), KeyframeId(7)}, {KeyframeId(5)}, false, 1000);
  for (auto& pose : adjustment.problem().poses) pose.state.T_world_body.translation.x() += 1;
  optimization::BundleResult result;
  result.reason = "for the test";
  result.outlier.assign(adjustment.problem().observations.size(), 1);
  const auto before = m.map.version();
  adjustment.apply(m.map, result);
  EXPECT_EQ(m.map.version(), before);
  EXPECT_EQ(largest_pose_error(), 0);
}

TEST_F(LocalAdjustment, HoldsTheFixedKeyframesAndTheLimitOfPoints) {
  disturb(0.003, 0.015);
  const SE3 fixed = m.map.T_world_body(KeyframeId(5));
  MapAdjustment adjustment(m.map, {KeyframeId(6), KeyframeId(7)}, {KeyframeId(5)}, false, 50);
  EXPECT_EQ(adjustment.problem().points.size(), 50u);
  const auto result = optimization::adjust_bundle(adjustment.problem(), {});
  adjustment.apply(m.map, result);
  EXPECT_EQ(fixed.local(m.map.T_world_body(KeyframeId(5))).norm(), 0);
  EXPECT_FALSE(m.map.find_inconsistency());
}

/// Keyframes along a motion with its IMU, in a visual world that is tilted.
struct InertialMap {
  SyntheticWorld world{1500, {6, 6, 3}, 2};
  SyntheticMap m{world};
  MapId id{0};
  MappingOptions options;

  InertialMap(int keyframes, bool moving) {
    std::mt19937 rng(3);
    options.use_imu = true;
    for (int i = 0; i < keyframes; ++i) {
      const Nanoseconds end = i * m.interval_ns, begin = end - m.interval_ns;
      const SE3 T = synthetic::Motion::state(moving ? end : 0).T_world_body;
      const KeyframeId k = m.add(T, {.noise_px = 0.1, .flipped_bits = 0}, rng);
      if (i == 0) continue;
      std::vector<ImuSample> samples = synthetic::regular_samples(begin, end, 5'000'000);
      for (ImuSample& s : samples) {
        if (!moving) {
          s.gyro.setZero();
          s.accel = T.rotation.conjugate() * -kGravityWorld;
        }
        s.gyro += Vector3d(0.01, -0.02, 0.015);
      }
      m.map.set_imu(k, std::make_shared<const PreintegratedImu>(samples, begin, end, ImuBias{},
                                                                ImuCalibration{}));
    }
    m.map.transform_map(id, SE3(so3::exp({0.6, -0.4, 0.2}), Vector3d(0.3, 0.1, -0.2)));
  }
  double tilt_error(KeyframeId k) const {
    const Vector3d up = m.map.T_world_body(k).rotation.conjugate() * Vector3d::UnitZ();
    const Vector3d expected = m.truth[k.value()].rotation.conjugate() * Vector3d::UnitZ();
    return std::acos(std::min(1.0, up.dot(expected)));
  }
};

TEST(AlignToImu, TurnsTheWorldUprightAndFindsVelocityAndBias) {
  InertialMap t(20, true);
  ASSERT_GT(t.tilt_error(KeyframeId(5)), 0.3);
  const ImuStep step = align_to_imu(t.m.map, t.id, t.options, nullptr);
  ASSERT_EQ(step.kind, ImuStep::Kind::kInitialised) << step.reason;
  EXPECT_TRUE(t.m.map.map_info(t.id).imu_initialized);
  for (std::uint32_t k = 0; k < 20; ++k) {
    const NavState& s = t.m.map.keyframe(KeyframeId(k)).state;
    EXPECT_LT(t.tilt_error(KeyframeId(k)), 0.01) << k;
    EXPECT_LT((s.bias.gyro - Vector3d(0.01, -0.02, 0.015)).norm(), 2e-3) << k;
    const NavState truth = synthetic::Motion::state(k * t.m.interval_ns);
    const Vector3d v_body = s.T_world_body.rotation.conjugate() * s.v_world;
    EXPECT_LT((v_body - truth.T_world_body.rotation.conjugate() * truth.v_world).norm(), 0.05) << k;
  }
  EXPECT_FALSE(t.m.map.find_inconsistency());
  // Four seconds are not enough for the first refinement.
  EXPECT_EQ(align_to_imu(t.m.map, t.id, t.options, nullptr).kind, ImuStep::Kind::kNone);
  t.options.imu_refine_first_s = t.options.imu_refine_second_s = 3;
  EXPECT_EQ(align_to_imu(t.m.map, t.id, t.options, nullptr).kind, ImuStep::Kind::kRefined);
  EXPECT_EQ(align_to_imu(t.m.map, t.id, t.options, nullptr).kind, ImuStep::Kind::kRefined);
  EXPECT_EQ(align_to_imu(t.m.map, t.id, t.options, nullptr).kind, ImuStep::Kind::kNone);
  for (std::uint32_t k = 0; k < 20; ++k) EXPECT_LT(t.tilt_error(KeyframeId(k)), 0.01) << k;
}

TEST(AlignToImu, SaysWhenThereIsTooLittleMotion) {
  InertialMap t(20, false);
  const auto before = t.m.map.version();
  const ImuStep step = align_to_imu(t.m.map, t.id, t.options, nullptr);
  EXPECT_EQ(step.kind, ImuStep::Kind::kFailed);
  EXPECT_FALSE(step.reason.empty());
  EXPECT_FALSE(t.m.map.map_info(t.id).imu_initialized);
  EXPECT_EQ(t.m.map.version(), before);
}

TEST(AlignToImu, WaitsForEnoughKeyframesWithoutGap) {
  InertialMap t(20, true);
  t.m.map.set_imu(KeyframeId(12), nullptr);  // seven intervals are left behind the gap
  EXPECT_EQ(align_to_imu(t.m.map, t.id, t.options, nullptr).kind, ImuStep::Kind::kNone);
}

}  // namespace
}  // namespace fastloop::mapping
