#include <gtest/gtest.h>

#include <random>

#include "fastloop/geometry/camera.hpp"
#include "fastloop/geometry/se3.hpp"

namespace fastloop {
namespace {

Vector3d random_vector(std::mt19937& rng, double scale) {
  std::uniform_real_distribution<double> u(-scale, scale);
  return {u(rng), u(rng), u(rng)};
}

TEST(So3, LogInvertsExpUpToPi) {
  std::mt19937 rng(1);
  for (double angle : {0.0, 1e-12, 1e-8, 1e-4, 0.5, 2.0, 3.1, M_PI - 1e-7}) {
    const Vector3d phi = angle * random_vector(rng, 1).normalized();
    EXPECT_LT((so3::log(so3::exp(phi)) - phi).norm(), 1e-9) << angle;
  }
}

TEST(So3, RightJacobianMatchesDifferences) {
  std::mt19937 rng(2);
  for (int i = 0; i < 50; ++i) {
    const Vector3d phi = random_vector(rng, i == 0 ? 1e-7 : 1.7);
    const Matrix3d j = so3::right_jacobian(phi);
    EXPECT_LT((j * so3::right_jacobian_inverse(phi) - Matrix3d::Identity()).norm(), 1e-9);
    for (int k = 0; k < 3; ++k) {
      const Vector3d d = 1e-6 * Vector3d::Unit(k);
      const Vector3d plus = so3::log(so3::exp(phi).conjugate() * so3::exp(phi + d));
      const Vector3d minus = so3::log(so3::exp(phi).conjugate() * so3::exp(phi - d));
      EXPECT_LT(((plus - minus) / 2e-6 - j.col(k)).norm(), 1e-7);
    }
  }
}

TEST(Se3, GroupAndRetraction) {
  std::mt19937 rng(3);
  for (int i = 0; i < 50; ++i) {
    const SE3 a(so3::exp(random_vector(rng, 2)), random_vector(rng, 5));
    const SE3 b(so3::exp(random_vector(rng, 2)), random_vector(rng, 5));
    const Vector3d p = random_vector(rng, 3);
    EXPECT_LT(((a * b) * p - a * (b * p)).norm(), 1e-12);
    EXPECT_LT((a.inverse() * (a * p) - p).norm(), 1e-12);
    const SE3 c = a.retract(a.local(b));
    EXPECT_LT((c.matrix() - b.matrix()).norm(), 1e-12);
  }
}

Camera radtan() {
  return {CameraModel::kPinhole,
          752,
          480,
          458.654,
          457.296,
          367.215,
          248.375,
          {-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0}};
}
Camera fisheye() {
  return {CameraModel::kKannalaBrandt,
          512,
          512,
          190.978,
          190.973,
          254.931,
          256.897,
          {0.0034823, 0.000715, -0.0020532, 0.00020293, 0}};
}

class CameraTest : public testing::TestWithParam<Camera> {};

TEST_P(CameraTest, UnprojectInvertsProject) {
  const Camera camera = GetParam();
  for (double u = 1; u < camera.width; u += 31)
    for (double v = 1; v < camera.height; v += 29) {
      const Vector3d ray = camera.unproject({u, v});
      EXPECT_NEAR(ray.norm(), 1, 1e-12);
      EXPECT_LT((camera.project(3.7 * ray) - Eigen::Vector2d(u, v)).norm(), 1e-7) << u << " " << v;
    }
}

TEST_P(CameraTest, JacobianMatchesDifferences) {
  const Camera camera = GetParam();
  std::mt19937 rng(4);
  for (int i = 0; i < 200; ++i) {
    const Vector3d p = random_vector(rng, 1) + Vector3d(0, 0, 2.5);
    Eigen::Matrix<double, 2, 3> j;
    camera.project(p, &j);
    for (int k = 0; k < 3; ++k) {
      const Vector3d d = 1e-6 * Vector3d::Unit(k);
      const Eigen::Vector2d numeric = (camera.project(p + d) - camera.project(p - d)) / 2e-6;
      EXPECT_LT((numeric - j.col(k)).norm(), 1e-4);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(
    Models, CameraTest,
    testing::Values(radtan(), fisheye(),
                    Camera{CameraModel::kPinhole, 640, 480, 585, 585, 320, 240, {}}));

TEST(Camera, RefusesNonsense) {
  Camera c = radtan();
  EXPECT_FALSE(c.problem());
  c.fx = -1;
  EXPECT_TRUE(c.problem());
  c = radtan();
  c.distortion[2] = std::nan("");
  EXPECT_TRUE(c.problem());
  EXPECT_FALSE(radtan().is_projectable({0, 0, -1}));
  EXPECT_TRUE(fisheye().is_projectable({1, 0, -0.1}));
}

}  // namespace
}  // namespace fastloop
