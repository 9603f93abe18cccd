#include "fastloop/geometry/triangulation.hpp"

#include <gtest/gtest.h>

#include <random>

namespace fastloop {
namespace {

TEST(Triangulation, ExactRaysGiveThePoint) {
  std::mt19937 rng(11);
  std::uniform_real_distribution<double> u(-1, 1);
  for (int i = 0; i < 500; ++i) {
    const SE3 T_second_first(so3::exp(0.5 * Vector3d(u(rng), u(rng), u(rng))),
                             Vector3d(u(rng), u(rng), u(rng)));
    const Vector3d p(4 * u(rng), 4 * u(rng), 4 * u(rng));  // also beside and behind: fisheye
    const Vector3d a = p.normalized(), b = (T_second_first * p).normalized();
    const double cosine = parallax_cosine(a, b, T_second_first.rotation);
    if (std::abs(cosine) > 0.9999) continue;
    const auto midpoint = triangulate_midpoint(a, b, T_second_first);
    const auto dlt = triangulate_dlt(a, b, T_second_first);
    ASSERT_TRUE(midpoint && dlt);
    EXPECT_LT((*midpoint - p).norm(), 1e-8);
    EXPECT_LT((*dlt - p).norm(), 1e-6);
  }
}

TEST(Triangulation, NoisyRaysGiveAPointNearBoth) {
  std::mt19937 rng(12);
  std::normal_distribution<double> n(0, 0.002);  // about one pixel
  const SE3 T_second_first(Eigen::Quaterniond::Identity(), Vector3d(-0.5, 0, 0));
  for (int i = 0; i < 200; ++i) {
    const Vector3d p(n(rng) * 300, n(rng) * 300, 4);
    const Vector3d a = (p.normalized() + Vector3d(n(rng), n(rng), n(rng))).normalized();
    const Vector3d b =
        ((T_second_first * p).normalized() + Vector3d(n(rng), n(rng), n(rng))).normalized();
    for (const auto& found :
         {triangulate_midpoint(a, b, T_second_first), triangulate_dlt(a, b, T_second_first)}) {
      ASSERT_TRUE(found);
      EXPECT_GT(found->normalized().dot(a), std::cos(0.01));
      EXPECT_GT((T_second_first * *found).normalized().dot(b), std::cos(0.01));
    }
  }
}

TEST(Triangulation, ParallelRaysGiveNothing) {
  const SE3 T_second_first(Eigen::Quaterniond::Identity(), Vector3d(-0.5, 0, 0));
  const Vector3d ray = Vector3d(0.1, 0.2, 1).normalized();
  EXPECT_FALSE(triangulate_midpoint(ray, ray, T_second_first));
  EXPECT_FALSE(triangulate_dlt(ray, ray, T_second_first));
  EXPECT_FALSE(triangulate_dlt(ray, Vector3d::UnitX(), SE3()));
}

TEST(Triangulation, DivergingRaysMeetBehindTheCameras) {
  const SE3 T_second_first(Eigen::Quaterniond::Identity(), Vector3d(-0.5, 0, 0));
  const Vector3d a = Vector3d(-0.1, 0, 1).normalized(), b = Vector3d(0.1, 0, 1).normalized();
  EXPECT_LT(triangulate_midpoint(a, b, T_second_first)->z(), 0);
  EXPECT_LT(triangulate_dlt(a, b, T_second_first)->z(), 0);
}

}  // namespace
}  // namespace fastloop
