#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/imu_factor.hpp"
#include "fastloop/optimization/synthetic_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::optimization {
namespace {

using namespace synthetic;
using fastloop::synthetic::disturb;
using fastloop::synthetic::Motion;
using fastloop::synthetic::regular_samples;
using Vector15d = Eigen::Matrix<double, 15, 1>;
using Matrix15d = Eigen::Matrix<double, 15, 15>;

constexpr Nanoseconds kFrame = 50'000'000;
const ImuBias kTrueBias{{0.004, -0.003, 0.002}, {0.03, 0.05, -0.04}};

NavState true_state(Nanoseconds stamp_ns) {
  NavState s = Motion::state(stamp_ns);
  s.bias = kTrueBias;
  return s;
}

/// Standard deviations of a state that has been tracked for a while.
Vector15d prior_stddev() {
  Vector15d s;
  s << Vector3d::Constant(0.002), Vector3d::Constant(0.005), Vector3d::Constant(0.02),
      Vector3d::Constant(5e-4), Vector3d::Constant(0.01);
  return s;
}

/// Everything that a problem points to.
struct Frame {
  StereoRig rig;
  std::optional<PreintegratedImu> imu;
  std::vector<PoseObservation> observations;
  NavState truth;
  InertialPoseProblem problem;
};

Frame make_frame(const StereoRig& rig, int num_observations, std::mt19937& rng,
                 Nanoseconds begin = 0) {
  Frame f;
  f.rig = rig;
  const ImuCalibration noise;
  auto samples = regular_samples(begin, begin + kFrame, 5'000'000);
  disturb(samples, kTrueBias, noise, rng);
  const NavState previous = true_state(begin);
  f.truth = true_state(begin + kFrame);
  f.truth.bias.gyro += normal_vector(rng, noise.gyro_random_walk * std::sqrt(0.05));
  f.truth.bias.accel += normal_vector(rng, noise.accel_random_walk * std::sqrt(0.05));
  Vector15d d = Vector15d::Zero();
  std::normal_distribution<double> n(0, 1);
  for (int i = 0; i < 15; ++i) d(i) = prior_stddev()(i) * n(rng);
  NavPrior prior;
  // The prior's error is measured from its mean: mean.retract(d) == truth.
  prior.mean = retract(previous, -d);
  prior.information = prior_stddev().cwiseAbs2().cwiseInverse().asDiagonal();
  f.imu.emplace(samples, begin, begin + kFrame, prior.mean.bias, noise);
  f.observations = observations(rig, f.truth.T_world_body, num_observations, 1.0, rng);
  f.problem.previous = prior.mean;
  f.problem.prior = prior;
  f.problem.initial = f.imu->predict(prior.mean);
  return f;
}

/// The problem with its pointers set to where the frame lives now.
InertialPoseResult solve(Frame& f) {
  f.problem.rig = &f.rig;
  f.problem.imu = &*f.imu;
  f.problem.observations = f.observations;
  return optimize_pose_inertial(f.problem);
}

bool is_symmetric_psd(const Matrix15d& m) {
  if (!m.allFinite() || m != m.transpose()) return false;
  const Vector15d s = m.diagonal().cwiseMax(1e-12).cwiseSqrt().cwiseInverse();
  const Matrix15d scaled = s.asDiagonal() * m * s.asDiagonal();
  return Eigen::SelfAdjointEigenSolver<Matrix15d>(scaled).eigenvalues().minCoeff() > -1e-9;
}

class InertialPose : public testing::TestWithParam<bool> {
 protected:
  StereoRig rig() const { return GetParam() ? fisheye_rig() : rectified_rig(); }
};

TEST_P(InertialPose, ErrorAgreesWithTheMarginalPrior) {
  std::mt19937 rng(1);
  const int trials = 300;
  double nees = 0;
  for (int i = 0; i < trials; ++i) {
    Frame f = make_frame(rig(), 150, rng, (i % 40) * 100'000'000LL);
    const InertialPoseResult result = solve(f);
    EXPECT_TRUE(is_symmetric_psd(result.prior.information));
    const Vector15d e = local(result.state, f.truth);
    nees += e.dot(result.prior.information * e) / trials;
  }
  // Chi-square of 15 numbers, mean over trials known to 0.3; gating costs a little information.
  EXPECT_GT(nees, 13.5);
  EXPECT_LT(nees, 17.5);
}

TEST_P(InertialPose, IsBetterThanVisionAlone) {
  std::mt19937 rng(2);
  double with = 0, without = 0;
  for (int i = 0; i < 100; ++i) {
    Frame f = make_frame(rig(), 40, rng);
    with += local(solve(f).state, f.truth).head<6>().squaredNorm();
    const PoseOnlyResult visual =
        optimize_pose(f.rig, f.problem.initial.T_world_body, f.observations);
    without += visual.T_world_body.local(f.truth.T_world_body).squaredNorm();
  }
  EXPECT_LT(with, 0.8 * without);
}

TEST_P(InertialPose, TracksAChainOfFramesAndLearnsTheBias) {
  std::mt19937 rng(3);
  const ImuCalibration noise;
  const int frames = 120;
  auto samples = regular_samples(0, frames * kFrame, 5'000'000);
  disturb(samples, kTrueBias, noise, rng);
  NavState state = Motion::state(0);
  NavPrior prior;
  prior.mean = state;
  Vector15d stddev = prior_stddev();
  stddev.tail<6>() << Vector3d::Constant(0.01), Vector3d::Constant(0.1);
  prior.information = stddev.cwiseAbs2().cwiseInverse().asDiagonal();
  double nees = 0;
  for (int k = 0; k < frames; ++k) {
    const NavState truth = true_state((k + 1) * kFrame);
    const PreintegratedImu imu(samples, k * kFrame, (k + 1) * kFrame, state.bias, noise);
    const StereoRig r = rig();
    const auto obs = observations(r, truth.T_world_body, 100, 1.0, rng);
    InertialPoseProblem problem{&r, obs, state, &imu, prior, imu.predict(state)};
    const InertialPoseResult result = optimize_pose_inertial(problem);
    EXPECT_GT(result.num_inliers, 80);
    state = result.state;
    prior = result.prior;
    const Vector15d e = local(state, truth);
    if (k >= 20) nees += e.dot(prior.information * e) / (frames - 20);
    EXPECT_LT(e.segment<3>(3).norm(), 0.03);
  }
  EXPECT_LT((state.bias.gyro - kTrueBias.gyro).norm(), 2e-3);
  EXPECT_LT((state.bias.accel - kTrueBias.accel).norm(), 0.03);
  // Errors of one chain are correlated, so the bounds are wide.
  EXPECT_GT(nees, 4);
  EXPECT_LT(nees, 30);
}

TEST_P(InertialPose, RejectsOutliers) {
  std::mt19937 rng(4);
  for (int i = 0; i < 20; ++i) {
    Frame f = make_frame(rig(), 200, rng);
    add_outliers(f.observations, 0.3, rng);
    const InertialPoseResult result = solve(f);
    for (int k = 0; k < 60; ++k) EXPECT_EQ(result.inlier[k], 0);
    EXPECT_GT(result.num_inliers, 120);
    EXPECT_LT(local(result.state, f.truth).segment<3>(3).norm(), 0.02);
  }
}

TEST_P(InertialPose, WithoutObservationsTheImuPredicts) {
  std::mt19937 rng(5);
  Frame f = make_frame(rig(), 0, rng);
  const InertialPoseResult result = solve(f);
  EXPECT_EQ(result.num_inliers, 0);
  EXPECT_LT(local(result.state, f.imu->predict(f.problem.previous)).norm(), 1e-6);
  EXPECT_TRUE(is_symmetric_psd(result.prior.information));
}

TEST_P(InertialPose, HoldsThePreviousStateWithoutPrior) {
  std::mt19937 rng(6);
  double nees = 0;
  const int trials = 200;
  for (int i = 0; i < trials; ++i) {
    Frame f = make_frame(rig(), 100, rng);
    f.problem.prior.reset();
    f.problem.previous = true_state(0);
    f.problem.initial = f.imu->predict(f.problem.previous);
    const InertialPoseResult result = solve(f);
    const Vector15d e = local(result.state, f.truth);
    nees += e.dot(result.prior.information * e) / trials;
  }
  EXPECT_GT(nees, 13.0);
  EXPECT_LT(nees, 18.0);
}

TEST_P(InertialPose, RelaxesTheGateWhenFewObservationsAreLeft) {
  std::mt19937 rng(7);
  Frame f = make_frame(rig(), 20, rng);
  // Landmarks off by three standard deviations: beyond the gate, within the relaxed one.
  for (PoseObservation& o : f.observations) o.pixel.left.y() += 1.5;
  for (int i = 0; i < 10; ++i) f.observations[i].pixel.left.y() += 1.7;
  const InertialPoseResult result = solve(f);
  EXPECT_GT(result.num_inliers, 15);
}

TEST_P(InertialPose, ReportsDegenerateInput) {
  std::mt19937 rng(8);
  Frame f = make_frame(rig(), 50, rng);
  EXPECT_THROW(optimize_pose_inertial({}), InvalidArgument);

  for (PoseObservation& o : f.observations)
    o.p_world.setConstant(std::numeric_limits<double>::quiet_NaN());
  EXPECT_EQ(solve(f).num_inliers, 0);

  f.problem.initial.v_world.x() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_TRUE(solve(f).state.v_world.allFinite());

  f.problem.previous.v_world.x() = std::numeric_limits<double>::quiet_NaN();
  const InertialPoseResult result = solve(f);
  EXPECT_EQ(result.num_inliers, 0);
  EXPECT_TRUE(result.prior.information.isZero());
}

TEST_P(InertialPose, IsDeterministic) {
  std::mt19937 rng(9);
  Frame f = make_frame(rig(), 200, rng);
  const InertialPoseResult a = solve(f), b = solve(f);
  EXPECT_TRUE(a.prior.information == b.prior.information);
  EXPECT_TRUE(local(a.state, b.state).isZero(0));
  EXPECT_EQ(a.inlier, b.inlier);
}

INSTANTIATE_TEST_SUITE_P(Rigs, InertialPose, testing::Values(false, true));

}  // namespace
}  // namespace fastloop::optimization
