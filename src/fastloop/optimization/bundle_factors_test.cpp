#include "fastloop/optimization/bundle_factors.hpp"

#include <gtest/gtest.h>

#include "fastloop/optimization/synthetic_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::optimization {
namespace {

using namespace synthetic;
using fastloop::synthetic::Motion;
using fastloop::synthetic::regular_samples;

NavState random_state(std::mt19937& rng) {
  NavState s;
  s.T_world_body = random_pose(rng, 1, 3);
  s.v_world = normal_vector(rng, 1);
  s.bias = {normal_vector(rng, 0.01), normal_vector(rng, 0.05)};
  return s;
}

PreintegratedImu measurements(const ImuBias& bias) {
  return PreintegratedImu(regular_samples(0, 500'000'000, 5'000'000), 0, 300'000'000, bias, {});
}

TEST(ImuFactor, JacobiansMatchDifferences) {
  std::mt19937 rng(1);
  for (int trial = 0; trial < 20; ++trial) {
    const NavState from = random_state(rng);
    // About another bias than that of the state, so that the first-order correction takes part.
    const PreintegratedImu imu = measurements({from.bias.gyro + normal_vector(rng, 0.01), {}});
    const NavState to = retract(imu.predict(from), 0.1 * ImuFactor::Vector15d::Random());
    const ImuFactor factor(imu);
    ImuFactor::Matrix15d j_from, j_to;
    factor.residual(from, to, &j_from, &j_to);
    const double h = 1e-5;
    for (int k = 0; k < 15; ++k) {
      const ImuFactor::Vector15d d = h * ImuFactor::Vector15d::Unit(k);
      const ImuFactor::Vector15d by_from =
          (factor.residual(retract(from, d), to) - factor.residual(retract(from, -d), to)) /
          (2 * h);
      const ImuFactor::Vector15d by_to =
          (factor.residual(from, retract(to, d)) - factor.residual(from, retract(to, -d))) /
          (2 * h);
      EXPECT_LT((by_from - j_from.col(k)).norm(), 1e-5 * (1 + j_from.col(k).norm())) << k;
      EXPECT_LT((by_to - j_to.col(k)).norm(), 1e-5 * (1 + j_to.col(k).norm())) << k;
    }
  }
}

TEST(ImuFactor, IsZeroForThePredictionAndWhitenedByTheCovariance) {
  std::mt19937 rng(2);
  const NavState from = random_state(rng);
  const PreintegratedImu imu = measurements(from.bias);
  const ImuFactor factor(imu);
  EXPECT_LT(factor.residual(from, imu.predict(from)).norm(), 1e-6);
  const auto w = sqrt_information_of(imu.covariance());
  EXPECT_LT((w * imu.covariance() * w.transpose() - Eigen::Matrix<double, 9, 9>::Identity()).norm(),
            1e-8);
}

TEST(ImuFactor, RetractAndLocalAreInverse) {
  std::mt19937 rng(3);
  const NavState a = random_state(rng), b = random_state(rng);
  const NavState c = retract(a, local(a, b));
  EXPECT_LT(local(b, c).norm(), 1e-12);
}

TEST(PoseManifold, PlusAndMinusAreInverse) {
  std::mt19937 rng(4);
  const PoseManifold manifold;
  double x[7], y[7], z[7];
  for (int i = 0; i < 20; ++i) {
    pose_to_parameters(random_pose(rng, 1, 3), x);
    pose_to_parameters(random_pose(rng, 1, 3), y);
    double d[6];
    ASSERT_TRUE(manifold.Minus(y, x, d) && manifold.Plus(x, d, z));
    EXPECT_LT(pose_from_parameters(y).local(pose_from_parameters(z)).norm(), 1e-12);
  }
}

TEST(TiltManifold, TurnsAboutHorizontalAxesOnly) {
  std::mt19937 rng(7);
  const TiltManifold manifold;
  double x[7], y[7], back[2], jacobian[14];
  pose_to_parameters(random_pose(rng, 1, 3), x);
  ASSERT_TRUE(manifold.PlusJacobian(x, jacobian));
  for (int k = 0; k < 2; ++k) {
    const double h = 1e-6;
    double d[2] = {0, 0};
    d[k] = h;
    ASSERT_TRUE(manifold.Plus(x, d, y) && manifold.Minus(y, x, back));
    EXPECT_NEAR(back[k], h, 1e-12);
    EXPECT_NEAR(back[1 - k], 0, 1e-12);
    const Vector6d moved = pose_from_parameters(x).local(pose_from_parameters(y)) / h;
    for (int row = 0; row < 6; ++row) EXPECT_NEAR(moved(row), jacobian[2 * row + k], 1e-5);
  }
}

/// Checks the Jacobians of a cost function by differences in the perturbation of each block.
void check_jacobians(const ceres::CostFunction& cost, const std::vector<std::vector<double>>& x,
                     double tolerance) {
  const PoseManifold manifold;
  const int rows = cost.num_residuals();
  std::vector<const double*> blocks;
  std::vector<std::vector<double>> jacobians;
  std::vector<double*> jacobian_pointers;
  for (const auto& b : x) {
    blocks.push_back(b.data());
    jacobians.emplace_back(rows * b.size());
  }
  for (auto& j : jacobians) jacobian_pointers.push_back(j.data());
  Eigen::VectorXd r(rows), plus(rows), minus(rows);
  ASSERT_TRUE(cost.Evaluate(blocks.data(), r.data(), jacobian_pointers.data()));
  for (std::size_t b = 0; b < x.size(); ++b) {
    const int size = static_cast<int>(x[b].size());
    for (int k = 0; k < (size == 7 ? 6 : size); ++k) {
      const double h = 1e-6;
      const auto moved = [&](double step) {
        std::vector<double> result = x[b];
        std::vector<double> d(6, 0.0);
        d[k] = step;
        if (size == 7) {
          manifold.Plus(x[b].data(), d.data(), result.data());
        } else {
          result[k] += step;
        }
        return result;
      };
      auto shifted = blocks;
      const auto up = moved(h), down = moved(-h);
      shifted[b] = up.data();
      ASSERT_TRUE(cost.Evaluate(shifted.data(), plus.data(), nullptr));
      shifted[b] = down.data();
      ASSERT_TRUE(cost.Evaluate(shifted.data(), minus.data(), nullptr));
      const Eigen::VectorXd numeric = (plus - minus) / (2 * h);
      Eigen::VectorXd analytic(rows);
      for (int row = 0; row < rows; ++row) analytic(row) = jacobians[b][row * size + k];
      EXPECT_LT((numeric - analytic).norm(), tolerance * (1 + analytic.norm())) << b << " " << k;
    }
  }
}

template <int kRows>
void check_reprojection(const StereoRig& rig, std::mt19937& rng) {
  const ReprojectionRig shared(rig);
  int checked = 0;
  const SE3 T = random_pose(rng, 1, 3);
  for (const PoseObservation& o : observations(rig, T, 40, 2, rng)) {
    if (rig.residual_size(o.pixel) != kRows) continue;
    const double weight = 0.7;
    const ReprojectionCost<kRows> cost(shared, o.pixel, &weight);
    std::vector<double> pose(7), point(o.p_world.data(), o.p_world.data() + 3);
    pose_to_parameters(T, pose.data());
    check_jacobians(cost, {pose, point}, 1e-5);
    ++checked;
  }
  EXPECT_GT(checked, 5);
}

TEST(ReprojectionCost, JacobiansMatchDifferences) {
  std::mt19937 rng(5);
  check_reprojection<2>(rectified_rig(), rng);
  check_reprojection<3>(rectified_rig(), rng);
  check_reprojection<2>(fisheye_rig(), rng);
  check_reprojection<4>(fisheye_rig(), rng);
}

TEST(ReprojectionCost, IsConstantBehindTheCameraAndNothingWithoutWeight) {
  const StereoRig rig = rectified_rig();
  const ReprojectionRig shared(rig);
  double weight = 1;
  PixelObservation pixel;
  pixel.left = {100, 100};
  const ReprojectionCost<2> cost(shared, pixel, &weight);
  const Vector3d behind = rig.T_body_left * Vector3d(0, 0, -3);
  double pose[7], r[2], j_pose[14], j_point[6];
  pose_to_parameters(SE3(), pose);
  const double* parameters[] = {pose, behind.data()};
  double* jacobians[] = {j_pose, j_point};
  ASSERT_TRUE(cost.Evaluate(parameters, r, jacobians));
  EXPECT_GT(r[0] * r[0] + r[1] * r[1], chi2_gate(2));
  for (const double v : j_pose) EXPECT_EQ(v, 0);
  weight = 0;
  ASSERT_TRUE(cost.Evaluate(parameters, r, jacobians));
  EXPECT_EQ(r[0], 0);
  EXPECT_EQ(r[1], 0);
}

TEST(ImuCost, JacobiansMatchDifferences) {
  std::mt19937 rng(6);
  const NavState from = random_state(rng);
  const PreintegratedImu imu = measurements(from.bias);
  const NavState to = retract(imu.predict(from), 0.05 * ImuFactor::Vector15d::Random());
  std::vector<std::vector<double>> x;
  for (const NavState& s : {from, to}) {
    std::vector<double> pose(7), bias(6);
    pose_to_parameters(s.T_world_body, pose.data());
    Eigen::Map<Vector6d>(bias.data(), 6) << s.bias.gyro, s.bias.accel;
    x.push_back(pose);
    x.emplace_back(s.v_world.data(), s.v_world.data() + 3);
    x.push_back(bias);
  }
  check_jacobians(ImuCost(imu), x, 1e-4);
}

}  // namespace
}  // namespace fastloop::optimization
