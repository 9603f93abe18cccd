#include "fastloop/loop/gates.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include "fastloop/map/ring_map_for_tests.hpp"

/// The gates on a correction, each with a demand just inside and one just outside.
namespace fastloop::loop {
namespace {

constexpr double kOff = 1e-6;

/// 30 keyframes on a circle, one metre of arc apart; a match of the last one with keyframe 4 that
/// demands a motion of the test's choice.
class MotionGates : public ::testing::Test {
 protected:
  MotionGates() : map_(make_map()) {}

  static map::Map make_map() {
    map::testing::RingMapOptions o;
    o.keyframes = 30;
    o.fresh = 3;
    o.yaw_drift = 0;
    o.imu = false;
    return map::testing::ring_map(o);
  }
  /// Reason to refuse a correction that turns the current camera about the world's axes and shifts
  /// it.
  std::optional<std::string> refusal(const Vector3d& turn, const Vector3d& shift = Vector3d::Zero(),
                                     bool merge = false) {
    match_ = {};
    match_.current = current_;
    match_.matched = matched_;
    match_.merge = merge;
    SE3 T = map_.T_world_camera(current_);
    T.rotation = so3::exp(turn) * T.rotation;
    T.translation += shift;
    match_.T_camera_world = T.inverse();
    report_ = {};
    return check_motion(map_, options_, match_, report_);
  }
  bool accepts(const Vector3d& turn, const Vector3d& shift = Vector3d::Zero(), bool merge = false) {
    const bool accepted = !refusal(turn, shift, merge);
    // The last reading is the one that decided.
    if (!report_.gates.empty()) {
      EXPECT_EQ(report_.gates.back().passed, accepted);
      EXPECT_EQ(std::abs(report_.gates.back().value) <= report_.gates.back().threshold, accepted);
    }
    return accepted;
  }

  map::Map map_;
  KeyframeId current_{29}, matched_{4};
  LoopOptions options_;
  RegionMatch match_;
  CandidateReport report_;
};

TEST_F(MotionGates, RollAndPitchWhereGravityIsKnown) {
  options_.inertial = true;
  for (const Vector3d& axis : {Vector3d(1, 0, 0), Vector3d(0, 1, 0)})
    for (const double sign : {-1.0, 1.0})
      for (const bool merge : {false, true}) {
        EXPECT_TRUE(accepts(sign * (options_.max_tilt_rad - kOff) * axis, {0, 0, 0}, merge));
        EXPECT_FALSE(accepts(sign * (options_.max_tilt_rad + kOff) * axis, {0, 0, 0}, merge));
      }
  options_.inertial = false;
  EXPECT_TRUE(accepts(2 * options_.max_tilt_rad * Vector3d::UnitX()));
}

TEST_F(MotionGates, YawOfALoopWhereGravityIsKnown) {
  options_.inertial = true;
  options_.max_drift_ratio = 0;  // the gates on drift are off
  for (const double sign : {-1.0, 1.0}) {
    EXPECT_TRUE(accepts({0, 0, sign * (options_.max_yaw_rad - kOff)}));
    EXPECT_FALSE(accepts({0, 0, sign * (options_.max_yaw_rad + kOff)}));
    // Maps that are joined may be turned as they like.
    EXPECT_TRUE(accepts({0, 0, sign * 3}, {0, 0, 0}, true));
  }
  options_.inertial = false;
  EXPECT_TRUE(accepts({0, 0, 2 * options_.max_yaw_rad}));
}

TEST_F(MotionGates, DriftInMetres) {
  const double path = path_length_m(map_, matched_, current_);
  for (const bool inertial : {false, true}) {
    options_.inertial = inertial;
    const double bound = options_.max_drift_constant_m + options_.max_drift_ratio * path;
    for (const Vector3d& way : {Vector3d(1, 0, 0), Vector3d(0, 0.6, -0.8)}) {
      EXPECT_TRUE(accepts({0, 0, 0}, (bound - kOff) * way));
      EXPECT_FALSE(accepts({0, 0, 0}, (bound + kOff) * way));
      EXPECT_TRUE(accepts({0, 0, 0}, (bound + kOff) * way, true));
    }
  }
  // Each of its two parts counts.
  options_.max_drift_constant_m = 0;
  EXPECT_TRUE(accepts({0, 0, 0}, {options_.max_drift_ratio * path - kOff, 0, 0}));
  EXPECT_FALSE(accepts({0, 0, 0}, {options_.max_drift_ratio * path + kOff, 0, 0}));
  options_.max_drift_ratio = 0;  // off
  EXPECT_TRUE(accepts({0, 0, 0}, {1000, 0, 0}));
}

TEST_F(MotionGates, DriftInRadians) {
  const double path = path_length_m(map_, matched_, current_);
  const double bound = options_.max_drift_constant_rad + options_.max_drift_rad_per_m * path;
  for (const Vector3d& axis : {Vector3d(0, 0, 1), Vector3d(0.6, 0.8, 0)}) {
    EXPECT_TRUE(accepts((bound - kOff) * axis));
    EXPECT_FALSE(accepts((bound + kOff) * axis));
    EXPECT_TRUE(accepts((bound + kOff) * axis, {0, 0, 0}, true));
  }
  options_.max_drift_rad_per_m = 0;
  EXPECT_TRUE(accepts({0, 0, options_.max_drift_constant_rad - kOff}));
  EXPECT_FALSE(accepts({0, 0, options_.max_drift_constant_rad + kOff}));
}

TEST_F(MotionGates, TheMatchLosesItsTiltWhereGravityIsKnown) {
  const Vector3d turn(0.004, -0.003, 0.1), shift(0.2, 0.1, -0.05);
  for (const bool inertial : {false, true}) {
    options_.inertial = inertial;
    ASSERT_FALSE(refusal(turn, shift).has_value());
    const SE3 before = map_.T_world_camera(current_), after = match_.T_camera_world.inverse();
    const Vector3d turned = so3::log(after.rotation * before.rotation.conjugate());
    EXPECT_LT((after.translation - before.translation - shift).norm(), 1e-9);
    EXPECT_NEAR(turned.z(), turn.z(), 1e-4);
    if (inertial)
      EXPECT_LT(turned.head<2>().norm(), 1e-9);
    else
      EXPECT_LT((turned - turn).norm(), 1e-9);
  }
}

TEST_F(MotionGates, PathIsTheWayAlongTheKeyframes) {
  const auto brute_force = [&](std::uint32_t from, std::uint32_t to) {
    double sum = 0;
    KeyframeId last(from);
    for (std::uint32_t i = from + 1; i <= to; ++i) {
      if (!map_.contains(KeyframeId(i))) continue;
      sum += (map_.T_world_body(KeyframeId(i)).translation - map_.T_world_body(last).translation)
                 .norm();
      last = KeyframeId(i);
    }
    return sum;
  };
  EXPECT_NEAR(path_length_m(map_, matched_, current_), brute_force(4, 29), 1e-9);
  EXPECT_NEAR(path_length_m(map_, matched_, current_), 25, 0.1);
  EXPECT_EQ(path_length_m(map_, current_, current_), 0);
  map_.remove_keyframe(KeyframeId(10));
  map_.remove_keyframe(KeyframeId(11));
  EXPECT_NEAR(path_length_m(map_, matched_, current_), brute_force(4, 29), 1e-9);
}

}  // namespace
}  // namespace fastloop::loop
