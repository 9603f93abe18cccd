#include "fastloop/geometry/sim3.hpp"

#include <gtest/gtest.h>

#include <random>
#include <unsupported/Eigen/MatrixFunctions>
#include <vector>

namespace fastloop {
namespace {

/// Tangents from tiny to large, with and without rotation and scale.
std::vector<Vector7d> tangents() {
  std::mt19937 engine(5);
  std::normal_distribution<double> normal(0, 1);
  std::vector<Vector7d> result{Vector7d::Zero()};
  for (double size : {1e-12, 1e-7, 1e-4, 1e-2, 0.3, 1.0, 2.5}) {
    for (int mask = 1; mask < 8; ++mask) {
      Vector7d d;
      for (int i = 0; i < 7; ++i) d[i] = normal(engine);
      d.head<3>().normalize();
      d.head<3>() *= mask & 1 ? size : 0;
      d.segment<3>(3) *= mask & 2 ? 10 * size : 0;
      d[6] *= mask & 4 ? 0.5 * size : 0;
      result.push_back(d);
    }
  }
  return result;
}

Eigen::Matrix4d matrix(const Sim3& s) {
  Eigen::Matrix4d m = Eigen::Matrix4d::Identity();
  m.topLeftCorner<3, 3>() = s.scale * s.rotation.toRotationMatrix();
  m.topRightCorner<3, 1>() = s.translation;
  return m;
}

TEST(Sim3, ExpIsTheMatrixExponential) {
  for (const Vector7d& d : tangents()) {
    Eigen::Matrix4d generator = Eigen::Matrix4d::Zero();
    generator.topLeftCorner<3, 3>() = so3::hat(d.head<3>()) + d[6] * Matrix3d::Identity();
    generator.topRightCorner<3, 1>() = d.segment<3>(3);
    const Eigen::Matrix4d expected = generator.exp();
    EXPECT_LT((matrix(Sim3::exp(d)) - expected).norm(), 1e-12 * expected.norm()) << d.transpose();
  }
}

TEST(Sim3, LogInvertsExp) {
  for (const Vector7d& d : tangents())
    EXPECT_LT((Sim3::exp(d).log() - d).norm(), 1e-12 * (1 + d.norm())) << d.transpose();
}

TEST(Sim3, GroupLaws) {
  const std::vector<Vector7d> all = tangents();
  for (std::size_t k = 0; k + 1 < all.size(); ++k) {
    const Sim3 a = Sim3::exp(all[k]), b = Sim3::exp(all[k + 1]);
    const Eigen::Matrix4d product = matrix(a) * matrix(b);
    EXPECT_LT((matrix(a * b) - product).norm(), 1e-12 * product.norm());
    EXPECT_LT((matrix(a * a.inverse()) - Eigen::Matrix4d::Identity()).norm(), 1e-11);
    const Vector3d p(0.3, -2, 5);
    EXPECT_LT((a * p - (matrix(a) * p.homogeneous()).head<3>()).norm(), 1e-11);
  }
}

TEST(Sim3, AdjointMovesTheTangentThrough) {
  const std::vector<Vector7d> all = tangents();
  for (std::size_t k = 0; k + 1 < all.size(); ++k) {
    const Sim3 a = Sim3::exp(all[k]);
    const Vector7d d = 0.1 * all[k + 1];
    const Eigen::Matrix4d left = matrix(a * Sim3::exp(d)), right = matrix(Sim3::exp(a.adjoint() * d) * a);
    EXPECT_LT((left - right).norm(), 1e-10 * (1 + left.norm()));
  }
}

TEST(Sim3, RightJacobianInverseIsTheDerivative) {
  for (const Vector7d& x : tangents()) {
    if (x.head<3>().norm() > 2) continue;  // keep away from the cut of the logarithm
    const Sim3 a = Sim3::exp(x);
    Matrix7d numeric;
    for (int c = 0; c < 7; ++c) {
      const Vector7d d = 1e-6 * Vector7d::Unit(c);
      numeric.col(c) = ((a * Sim3::exp(d)).log() - (a * Sim3::exp(-d)).log()) / 2e-6;
    }
    EXPECT_LT((sim3::right_jacobian_inverse(x) - numeric).norm(), 1e-7 * (1 + x.norm())) << x.transpose();
  }
}

}  // namespace
}  // namespace fastloop
