#include "fastloop/optimization/pose_only.hpp"

#include <gtest/gtest.h>

#include <limits>

#include "fastloop/optimization/reprojection.hpp"
#include "fastloop/optimization/rig_model.hpp"
#include "fastloop/optimization/synthetic_for_tests.hpp"

namespace fastloop::optimization {
namespace {

using namespace synthetic;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

StereoRig distorted_rectified_rig() {
  StereoRig rig = rectified_rig();
  rig.left.distortion = {-0.28, 0.07, 1e-4, 2e-5, 0};
  return rig;
}

class PoseOnly : public testing::TestWithParam<int> {
 protected:
  StereoRig rig() const {
    return GetParam() == 0   ? rectified_rig()
           : GetParam() == 1 ? fisheye_rig()
                             : distorted_rectified_rig();
  }
};

TEST_P(PoseOnly, RigModelEqualsTheRig) {
  std::mt19937 rng(11);
  const StereoRig r = rig();
  const RigModel model(r);
  std::vector<Vector3d> points{{0, 0, 0}, {0, 0, 2}, {0, 0, -2}, {1e-14, 0, 1}, {0, 0, kNan}};
  for (int i = 0; i < 500; ++i) points.push_back(normal_vector(rng, 3));
  int projected = 0;
  for (const Vector3d& p : points) {
    PixelObservation z;
    z.left = {120, 200};
    if (rng() % 3) z.right = {100, 201};
    StereoRig::Residual a = StereoRig::Residual::Zero(), b = a;
    StereoRig::Jacobian ja = StereoRig::Jacobian::Zero(), jb = ja;
    ASSERT_EQ(r.residual(p, z, &a, &ja), model.residual(p, z, &b, &jb)) << p.transpose();
    if (r.residual(p, z, &a) == 0) continue;
    ++projected;
    EXPECT_LT((a - b).norm(), 1e-9 * (1 + a.norm()));
    EXPECT_LT((ja - jb).norm(), 1e-9 * (1 + ja.norm()));
  }
  EXPECT_GT(projected, 200);
}

TEST_P(PoseOnly, GradientAndHessianMatchDifferences) {
  std::mt19937 rng(1);
  const SE3 truth = random_pose(rng, 0.5, 2);
  const auto obs = observations(rig(), truth, 60, 0.5, rng);
  const std::vector<std::uint8_t> active(obs.size(), 1);
  const SE3 T = truth.retract(Vector6d::Constant(0.01));
  for (const bool robust : {false, true}) {
    const auto cost = [&](const Vector6d& d) {
      const SE3 T_left_world = (T.retract(d) * rig().T_body_left).inverse();
      return 0.5 * accumulate_reprojection(rig(), T_left_world, obs, active, robust).cost;
    };
    const ReprojectionTerms terms = in_body_frame(
        accumulate_reprojection(rig(), (T * rig().T_body_left).inverse(), obs, active, robust),
        rig().T_body_left);
    for (int k = 0; k < 6; ++k) {
      const Vector6d d = 1e-6 * Vector6d::Unit(k);
      EXPECT_NEAR((cost(d) - cost(-d)) / 2e-6, terms.gradient(k), 1e-4 * terms.gradient.norm());
    }
  }
  // With residuals of zero the Gauss-Newton Hessian is the true one.
  const auto exact = observations(rig(), truth, 60, 0, rng);
  const auto gradient = [&](const Vector6d& d) {
    const SE3 T_left_world = (truth.retract(d) * rig().T_body_left).inverse();
    return in_body_frame(accumulate_reprojection(rig(), T_left_world, exact, active, false),
                         rig().T_body_left);
  };
  const Matrix6d h = gradient(Vector6d::Zero()).hessian;
  for (int k = 0; k < 6; ++k) {
    const Vector6d d = 1e-6 * Vector6d::Unit(k);
    const Vector6d column = (gradient(d).gradient - gradient(-d).gradient) / 2e-6;
    EXPECT_LT((column - h.col(k)).norm(), 1e-4 * h.col(k).norm());
  }
}

TEST_P(PoseOnly, FindsTheExactPoseWithoutNoise) {
  std::mt19937 rng(2);
  for (int i = 0; i < 20; ++i) {
    const SE3 truth = random_pose(rng, 1.0, 3);
    const auto obs = observations(rig(), truth, 100, 0, rng);
    const SE3 start = truth * random_pose(rng, 0.02, 0.05);
    const PoseOnlyResult result = optimize_pose(rig(), start, obs);
    EXPECT_LT(truth.local(result.T_world_body).norm(), 1e-7);
    EXPECT_EQ(result.num_inliers, 100);
  }
}

TEST_P(PoseOnly, ErrorAgreesWithItsCovariance) {
  std::mt19937 rng(3);
  const int trials = 200;
  double nees = 0, inliers = 0;
  for (int i = 0; i < trials; ++i) {
    const SE3 truth = random_pose(rng, 1.0, 3);
    const auto obs = observations(rig(), truth, 200, 0.8, rng);
    const PoseOnlyResult result = optimize_pose(rig(), truth * random_pose(rng, 0.02, 0.05), obs);
    const ReprojectionTerms terms =
        in_body_frame(accumulate_reprojection(rig(), (truth * rig().T_body_left).inverse(), obs,
                                              result.inlier, false),
                      rig().T_body_left);
    const Vector6d e = truth.local(result.T_world_body);
    nees += e.dot(terms.hessian * e) / trials;
    inliers += result.num_inliers / (200.0 * trials);
  }
  // Chi-square of 6 numbers. Taking out the 5 % beyond the gate makes the rest a little less
  // informative.
  EXPECT_GT(nees, 5.0);
  EXPECT_LT(nees, 8.0);
  EXPECT_NEAR(inliers, 0.95, 0.01);
}

TEST_P(PoseOnly, RejectsThirtyPercentOutliers) {
  std::mt19937 rng(4);
  for (int i = 0; i < 20; ++i) {
    const SE3 truth = random_pose(rng, 1.0, 3);
    auto obs = observations(rig(), truth, 300, 0.5, rng);
    add_outliers(obs, 0.3, rng);
    const PoseOnlyResult result = optimize_pose(rig(), truth * random_pose(rng, 0.02, 0.05), obs);
    EXPECT_LT(angle_between(truth, result.T_world_body), 2e-3);
    EXPECT_LT((truth.translation - result.T_world_body.translation).norm(), 0.02);
    int wrong = 0;
    for (int k = 0; k < 90; ++k) wrong += result.inlier[k];
    EXPECT_EQ(wrong, 0);
    EXPECT_GT(result.num_inliers, 180);
  }
}

TEST_P(PoseOnly, ReportsDegenerateInput) {
  std::mt19937 rng(5);
  const SE3 start = random_pose(rng, 1.0, 3);
  EXPECT_EQ(optimize_pose(rig(), start, {}).num_inliers, 0);

  auto obs = observations(rig(), start, 50, 0.5, rng);
  EXPECT_EQ(optimize_pose(rig(), start, std::span(obs).first(2)).num_inliers, 0);

  auto behind = obs;
  for (PoseObservation& o : behind) {
    const Vector3d p_left(0.001, 0.001, -5);
    o.p_world = start * (rig().T_body_left * p_left);
  }
  const PoseOnlyResult result = optimize_pose(rig(), start, behind);
  EXPECT_EQ(result.num_inliers, 0);
  EXPECT_TRUE(result.T_world_body.matrix() == start.matrix());

  // One point seen many times does not determine a pose; the answer must stay finite.
  std::vector<PoseObservation> same(50, obs[0]);
  EXPECT_TRUE(optimize_pose(rig(), start, same).T_world_body.is_finite());

  SE3 bad = start;
  bad.translation.x() = kNan;
  EXPECT_EQ(optimize_pose(rig(), bad, obs).num_inliers, 0);
}

TEST_P(PoseOnly, LeavesOutWhatIsNotFinite) {
  std::mt19937 rng(6);
  const SE3 truth = random_pose(rng, 1.0, 3);
  auto obs = observations(rig(), truth, 50, 0, rng);
  obs[0].p_world.x() = kNan;
  obs[1].pixel.left.y() = kNan;
  obs[2].inv_sigma2 = std::numeric_limits<double>::infinity();
  obs[4].pixel.right.x() = std::numeric_limits<double>::infinity();
  const PoseOnlyResult result = optimize_pose(rig(), truth * random_pose(rng, 0.02, 0.05), obs);
  EXPECT_LT(truth.local(result.T_world_body).norm(), 1e-7);
  EXPECT_EQ(result.num_inliers, 46);
  for (const int i : {0, 1, 2, 4}) EXPECT_EQ(result.inlier[i], 0);
}

TEST_P(PoseOnly, IsDeterministic) {
  std::mt19937 rng(7);
  const SE3 truth = random_pose(rng, 1.0, 3);
  auto obs = observations(rig(), truth, 200, 1, rng);
  add_outliers(obs, 0.2, rng);
  const SE3 start = truth * random_pose(rng, 0.02, 0.05);
  const PoseOnlyResult a = optimize_pose(rig(), start, obs), b = optimize_pose(rig(), start, obs);
  EXPECT_TRUE(a.T_world_body.matrix() == b.T_world_body.matrix());
  EXPECT_EQ(a.inlier, b.inlier);
}

INSTANTIATE_TEST_SUITE_P(Rigs, PoseOnly, testing::Values(0, 1, 2));

}  // namespace
}  // namespace fastloop::optimization
