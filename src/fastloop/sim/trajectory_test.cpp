#include "fastloop/sim/trajectory.hpp"

#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/motion.hpp"
#include "fastloop/sim/rig.hpp"

namespace fastloop::sim {
namespace {

Trajectory motion(WorldKind kind, double seconds, std::uint64_t seed = 5) {
  return make_motion(kind, seconds, seed, carrier_from_body(make_rig(CameraKind::kPinhole)));
}

TEST(Trajectory, DerivativesAreThoseOfThePose) {
  const Trajectory x = motion(WorldKind::kRoom, 12);
  const double h = 1e-4;
  for (double t = 1.03; t < 11; t += 0.37) {
    const SE3 before = x.pose(t - h), after = x.pose(t + h), now = x.pose(t);
    EXPECT_LT((x.velocity(t) - (after.translation - before.translation) / (2 * h)).norm(), 1e-6);
    EXPECT_LT((x.acceleration(t) - (x.velocity(t + h) - x.velocity(t - h)) / (2 * h)).norm(), 1e-5);
    const Vector3d turned = so3::log(before.rotation.conjugate() * after.rotation) / (2 * h);
    EXPECT_LT((x.angular_velocity(t) - turned).norm(), 1e-5);
    EXPECT_NEAR(now.rotation.norm(), 1, 1e-12);
  }
}

TEST(Trajectory, IsContinuousAcrossKnots) {
  const Trajectory x = motion(WorldKind::kHall, 6);
  for (double knot = 0.1; knot < 5.9; knot += 0.1) {
    const double e = 1e-9;
    EXPECT_LT((x.acceleration(knot - e) - x.acceleration(knot + e)).norm(), 1e-5);
    EXPECT_LT((x.angular_velocity(knot - e) - x.angular_velocity(knot + e)).norm(), 1e-5);
  }
}

TEST(Trajectory, FitFollowsRecordedPoses) {
  const Trajectory truth = motion(WorldKind::kRoom, 8);
  std::vector<double> times;
  std::vector<SE3> poses;
  for (double t = 0; t < 8; t += 0.005) {
    if (t > 4 && t < 4.08) continue;  // a gap in the record
    times.push_back(t);
    poses.push_back(truth.pose(t));
  }
  const Trajectory fit = Trajectory::fit(times, poses, 0.05);
  for (double t = 0; t < times.back(); t += 0.0131) {
    EXPECT_LT((fit.pose(t).translation - truth.pose(t).translation).norm(), 5e-4) << t;
    EXPECT_LT(angle_between(fit.pose(t), truth.pose(t)), 5e-4) << t;
  }
  EXPECT_LT((fit.acceleration(2) - truth.acceleration(2)).norm(), 0.05);
}

TEST(Trajectory, FitRefusesWhatIsNoMotion) {
  const std::vector<SE3> two(2);
  EXPECT_THROW(Trajectory::fit(std::vector<double>{1}, std::vector<SE3>(1), 0.1), InvalidArgument);
  EXPECT_THROW(Trajectory::fit(std::vector<double>{1, 1}, two, 0.1), InvalidArgument);
  EXPECT_THROW(Trajectory(0, 0.1, std::vector<SE3>(5)), InvalidArgument);
}

class Motion : public ::testing::TestWithParam<WorldKind> {};

TEST_P(Motion, StaysWithinTheSpeedOfAHand) {
  const double seconds = default_seconds(GetParam());
  const double fastest = GetParam() == WorldKind::kCampus ? 5.0 : 1.5;
  const double least = GetParam() == WorldKind::kRoom       ? 28
                       : GetParam() == WorldKind::kHall     ? 1.95 * floor_path(WorldKind::kHall).length()  // walked twice
                       : GetParam() == WorldKind::kCorridor ? 200
                       : GetParam() == WorldKind::kRing     ? floor_path(WorldKind::kRing).length()
                       : GetParam() == WorldKind::kCloister ? 1.9 * floor_path(WorldKind::kCloister).length()
                                                            : 1000;
  for (std::uint64_t seed = 1; seed <= 12; ++seed) {
    const Trajectory x = motion(GetParam(), seconds, seed);
    double path = 0;
    for (double t = 0; t < seconds; t += 0.04) {
      ASSERT_LE(x.velocity(t).norm(), fastest) << t << " seed " << seed;
      ASSERT_LE(x.angular_velocity(t).norm(), 1.5) << t << " seed " << seed;
      ASSERT_LE(x.acceleration(t).norm(), 6) << t << " seed " << seed;
      path += 0.04 * x.velocity(t).norm();
    }
    EXPECT_GT(path, least);
  }
}

TEST_P(Motion, RestsAtFirstThenExcitesTheImu) {
  const Trajectory x = motion(GetParam(), 20);
  EXPECT_LT(x.velocity(0.1).norm(), 1e-3);
  EXPECT_LT(x.angular_velocity(0.1).norm(), 1e-3);
  Vector3d most_rotation = Vector3d::Zero(), most_acceleration = Vector3d::Zero();
  for (double t = 0; t < 15; t += 0.05) {
    most_rotation = most_rotation.cwiseMax(x.angular_velocity(t).cwiseAbs());
    most_acceleration = most_acceleration.cwiseMax(x.acceleration(t).cwiseAbs());
  }
  EXPECT_GT(most_rotation.minCoeff(), 0.15);
  EXPECT_GT(most_acceleration.minCoeff(), 0.25);
}

TEST_P(Motion, ComesBackToPlacesItHasSeen) {
  const double seconds = default_seconds(GetParam());
  const Trajectory x = motion(GetParam(), seconds);
  // Some place after more than half of the sequence is near the start, looking the same way.
  double nearest = 1e9;
  for (double t = 0.5 * seconds; t <= seconds; t += 0.05) {
    if (angle_between(x.pose(t), x.pose(0)) > 0.5) continue;
    nearest = std::min(nearest, (x.pose(t).translation - x.pose(0).translation).norm());
  }
  EXPECT_LT(nearest, 0.6);
}

INSTANTIATE_TEST_SUITE_P(Worlds, Motion,
                         ::testing::Values(WorldKind::kRoom, WorldKind::kHall, WorldKind::kCorridor,
                                           WorldKind::kCampus, WorldKind::kRing,
                                           WorldKind::kCloister),
                         [](const auto& i) { return to_string(i.param); });

TEST(Motion, CorridorEndsWhereItBegan) {
  const double seconds = default_seconds(WorldKind::kCorridor);
  const Trajectory x = motion(WorldKind::kCorridor, seconds);
  EXPECT_LT((x.pose(seconds).translation - x.pose(0).translation).norm(), 0.15);
}

}  // namespace
}  // namespace fastloop::sim
