#include "fastloop/geometry/similarity_fit.hpp"

#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <random>

#include "fastloop/geometry/so3.hpp"

namespace fastloop {
namespace {

using Points = Eigen::Matrix<float, 3, 3>;  ///< columns

struct Draw {
  std::mt19937 rng;
  explicit Draw(unsigned seed) : rng(seed) {}
  double operator()() { return std::uniform_real_distribution<double>(-1, 1)(rng); }
  Vector3d vector() {
    const double x = (*this)(), y = (*this)(), z = (*this)();
    return {x, y, z};
  }
};

double error_of(const Points& a, const Points& b, const Matrix3d& r, const Vector3d& t, double s) {
  return ((s * r * a.cast<double>()).colwise() + t - b.cast<double>()).squaredNorm();
}

Matrix3d rotation_of(const SimilarityF& f) {
  Matrix3d r;
  for (int i = 0; i < 9; ++i) r(i / 3, i % 3) = static_cast<double>(f.rotation[i]);
  return r;
}

Vector3d translation_of(const SimilarityF& f) {
  return Eigen::Map<const Eigen::Vector3f>(f.translation).cast<double>();
}

class SimilarityFit : public ::testing::TestWithParam<bool> {};

// The oracle is Umeyama's solution by singular values. Triangles with noise far below their size
// cannot need a mirror image, so both find the same minimum. Umeyama's scale minimises the error
// after scaling, ours is the symmetric one: with free scale the rotations are compared.
TEST_P(SimilarityFit, FindsTheLeastSquaresRotation) {
  const bool fixed_scale = GetParam();
  Draw u(7);
  int tried = 0;
  for (int trial = 0; trial < 300; ++trial) {
    Points a, b;
    const Matrix3d r = so3::exp(3 * u.vector()).toRotationMatrix();
    const Vector3d t = 10 * u.vector();
    const double s = fixed_scale ? 1 : std::exp(u());
    for (int i = 0; i < 3; ++i) a.col(i) = (5 * u.vector()).cast<float>();
    for (int i = 0; i < 3; ++i)
      b.col(i) = (s * r * a.col(i).cast<double>() + t + 0.02 * u.vector()).cast<float>();
    const float area = (a.col(1) - a.col(0)).cross(a.col(2) - a.col(0)).norm();
    if (area < 0.5f) continue;
    ++tried;
    SimilarityF f;
    ASSERT_TRUE(fit_similarity(a.data(), b.data(), fixed_scale, &f));
    const Eigen::Matrix4d oracle =
        Eigen::umeyama(a.cast<double>(), b.cast<double>(), !fixed_scale);
    const Matrix3d block = oracle.topLeftCorner<3, 3>();
    const Matrix3d r_oracle = block / std::cbrt(block.determinant());
    EXPECT_LT((rotation_of(f) - r_oracle).norm(), 2e-5) << trial;
    EXPECT_NEAR(rotation_of(f).determinant(), 1, 1e-5);
    if (fixed_scale) {
      const double ours = error_of(a, b, rotation_of(f), translation_of(f), 1);
      const double best = error_of(a, b, block, oracle.topRightCorner<3, 1>(), 1);
      EXPECT_LT(ours, best + 1e-5);
    } else {
      EXPECT_NEAR(f.scale / s, 1, 0.05);
    }
  }
  EXPECT_GT(tried, 200);
}
INSTANTIATE_TEST_SUITE_P(Scale, SimilarityFit, ::testing::Bool());

TEST(SimilarityFit, TurnsATriangleOver) {
  // The normals are opposite: the rotation between them has no unique axis.
  const float a[9] = {0, 0, 0, 1, 0, 0, 0, 2, 0};
  const float b[9] = {0, 0, 0, 1, 0, 0, 0, -2, 0};
  SimilarityF f;
  ASSERT_TRUE(fit_similarity(a, b, true, &f));
  EXPECT_NEAR(rotation_of(f).determinant(), 1, 1e-6);
  for (int i = 0; i < 3; ++i) {
    const Eigen::Vector3d p(a[3 * i], a[3 * i + 1], a[3 * i + 2]);
    const Eigen::Vector3d q(b[3 * i], b[3 * i + 1], b[3 * i + 2]);
    EXPECT_LT((rotation_of(f) * p + translation_of(f) - q).norm(), 1e-5);
  }
}

TEST(SimilarityFit, RefusesPointsOnALine) {
  const float line[9] = {0, 0, 0, 1, 1, 1, 2, 2, 2};
  const float same[9] = {1, 2, 3, 1, 2, 3, 1, 2, 3};
  const float triangle[9] = {0, 0, 0, 1, 0, 0, 0, 1, 0};
  const float nan[9] = {0, 0, 0, 1, 0, NAN, 0, 1, 0};
  SimilarityF f;
  EXPECT_FALSE(fit_similarity(line, triangle, true, &f));
  EXPECT_FALSE(fit_similarity(triangle, line, true, &f));
  EXPECT_FALSE(fit_similarity(same, triangle, false, &f));
  EXPECT_FALSE(fit_similarity(nan, triangle, true, &f));
  EXPECT_TRUE(fit_similarity(triangle, triangle, true, &f));
}

}  // namespace
}  // namespace fastloop
