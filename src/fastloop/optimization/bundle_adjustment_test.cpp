#include "fastloop/optimization/bundle_adjustment.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/bundle_world_for_tests.hpp"

namespace fastloop::optimization {
namespace {

using namespace synthetic;

class Bundle : public testing::TestWithParam<bool> {
 protected:
  StereoRig rig() const { return GetParam() ? fisheye_rig() : rectified_rig(); }
};

double worst_position_error(const BundleWorld& w) {
  double worst = 0;
  for (std::size_t i = 0; i < w.problem.poses.size(); ++i)
    worst = std::max(worst, (w.problem.poses[i].state.T_world_body.translation -
                             w.truth.poses[i].state.T_world_body.translation)
                                .norm());
  return worst;
}

/// Rows of all residuals less unknowns of the problem: expected value of twice the cost at the
/// optimum.
double degrees_of_freedom(const BundleProblem& p) {
  std::vector<int> seen(p.points.size(), 0);
  double dof = 0;
  for (const BundleObservation& o : p.observations) {
    dof += p.rig.residual_size(o.pixel);
    seen[o.point] = 1;
  }
  for (const int s : seen) dof -= 3 * s;
  for (const BundlePose& pose : p.poses) {
    if (!pose.pose_fixed) dof -= 6;
    if (!p.imu_edges.empty()) dof -= 9;
  }
  return dof + 15.0 * static_cast<double>(p.imu_edges.size());
}

const BundleOptions kToTheEnd{.iterations = 30, .iterations_after_gate = 30};

TEST_P(Bundle, FindsTheExactWorldWithoutNoise) {
  BundleWorld w = make_bundle_world(rig(), {.sigma_px = 0}, 1);
  const BundleResult result = adjust_bundle(w.problem, kToTheEnd);
  ASSERT_TRUE(result.usable) << result.reason;
  EXPECT_LT(worst_position_error(w), 1e-4);
  EXPECT_LT(result.final_cost, 1e-4 * result.initial_cost);
  EXPECT_EQ(std::count(result.outlier.begin(), result.outlier.end(), 1), 0);
}

TEST_P(Bundle, CostAtTheOptimumIsAChiSquare) {
  BundleWorld w = make_bundle_world(rig(), {}, 2);
  const BundleResult result =
      adjust_bundle(w.problem, {.iterations = 30, .iterations_after_gate = 0, .robust = false});
  ASSERT_TRUE(result.usable) << result.reason;
  const double dof = degrees_of_freedom(w.problem);
  EXPECT_NEAR(2 * result.final_cost, dof, 5 * std::sqrt(2 * dof));
  EXPECT_LT(worst_position_error(w), 0.03);
  for (int i = 0; i < 2; ++i)
    EXPECT_TRUE(w.problem.poses[i].state.T_world_body.matrix() ==
                w.truth.poses[i].state.T_world_body.matrix());
}

TEST_P(Bundle, InertialCostIsAChiSquareAndBiasIsFound) {
  BundleWorld w = make_bundle_world(rig(), {.poses = 20, .fixed_poses = 1, .inertial = true}, 3);
  const BundleResult result =
      adjust_bundle(w.problem, {.iterations = 30, .iterations_after_gate = 0, .robust = false});
  ASSERT_TRUE(result.usable) << result.reason;
  // The true bias is constant, so the residuals of its random walk are smaller than the model
  // expects.
  const double walk = 6.0 * static_cast<double>(w.problem.imu_edges.size());
  const double dof = degrees_of_freedom(w.problem);
  EXPECT_GT(2 * result.final_cost, dof - walk - 5 * std::sqrt(2 * dof));
  EXPECT_LT(2 * result.final_cost, dof + 5 * std::sqrt(2 * dof));
  EXPECT_LT(worst_position_error(w), 0.03);
  for (std::size_t i = 0; i < w.problem.poses.size(); ++i) {
    const NavState &a = w.problem.poses[i].state, &b = w.truth.poses[i].state;
    EXPECT_LT((a.v_world - b.v_world).norm(), 0.03);
    EXPECT_LT((a.bias.gyro - b.bias.gyro).norm(), 2e-3);
    EXPECT_LT((a.bias.accel - b.bias.accel).norm(), 0.03);
  }
}

TEST_P(Bundle, RejectsOutliers) {
  BundleWorld w = make_bundle_world(rig(), {.outlier_fraction = 0.2}, 4);
  const BundleResult result = adjust_bundle(w.problem, kToTheEnd);
  ASSERT_TRUE(result.usable) << result.reason;
  EXPECT_LT(worst_position_error(w), 0.05);
  const double rejected =
      static_cast<double>(std::count(result.outlier.begin(), result.outlier.end(), 1)) /
      static_cast<double>(result.outlier.size());
  EXPECT_GT(rejected, 0.18);
  EXPECT_LT(rejected, 0.28);
}

TEST_P(Bundle, DefaultIterationsComeCloseToTheOptimum) {
  BundleWorld w = make_bundle_world(rig(), {.inertial = true}, 5), best = w;
  const BundleResult quick = adjust_bundle(w.problem);
  ASSERT_TRUE(quick.usable);
  const BundleResult full = adjust_bundle(best.problem, kToTheEnd);
  EXPECT_LT(quick.final_cost, 1.01 * full.final_cost);
  EXPECT_LE(quick.final_cost, quick.initial_cost);
}

TEST_P(Bundle, HoldsTheFirstPoseWhenNothingIsFixed) {
  BundleWorld w = make_bundle_world(rig(), {.fixed_poses = 0}, 6);
  w.problem.poses[0] = w.truth.poses[0];
  ASSERT_TRUE(adjust_bundle(w.problem, kToTheEnd).usable);
  EXPECT_TRUE(w.problem.poses[0].state.T_world_body.matrix() ==
              w.truth.poses[0].state.T_world_body.matrix());
  EXPECT_LT(worst_position_error(w), 0.04);
}

TEST_P(Bundle, FindsTheTiltOfTheWorldWhenNothingIsFixed) {
  BundleWorld w = make_bundle_world(rig(), {.poses = 20, .fixed_poses = 0, .inertial = true}, 6);
  // The whole visual world leans by 3 degrees about a horizontal axis through the first pose.
  w.problem = w.truth;
  const Vector3d pivot = w.truth.poses[0].state.T_world_body.translation;
  const Eigen::Quaterniond turn = so3::exp({0.04, -0.03, 0});
  const SE3 lean(turn, pivot - turn * pivot);
  for (BundlePose& p : w.problem.poses) {
    p.state.T_world_body = lean * p.state.T_world_body;
    p.state.v_world = lean.rotation * p.state.v_world;
  }
  for (Vector3d& p : w.problem.points) p = lean * p;
  const BundleResult result = adjust_bundle(w.problem, kToTheEnd);
  ASSERT_TRUE(result.usable) << result.reason;
  EXPECT_LT((w.problem.poses[0].state.T_world_body.translation - pivot).norm(), 1e-12);
  EXPECT_LT(
      angle_between(w.problem.poses[0].state.T_world_body, w.truth.poses[0].state.T_world_body),
      0.006);
  EXPECT_LT(worst_position_error(w), 0.05);
}

TEST_P(Bundle, KeepsMotionThatIsFixed) {
  BundleWorld w = make_bundle_world(rig(), {.inertial = true}, 7);
  w.problem.poses[0] = w.truth.poses[0];
  w.problem.poses[0].motion_fixed = true;
  const NavState before = w.problem.poses[0].state;
  ASSERT_TRUE(adjust_bundle(w.problem).usable);
  EXPECT_EQ(before.v_world, w.problem.poses[0].state.v_world);
  EXPECT_EQ(before.bias.gyro, w.problem.poses[0].state.bias.gyro);
  EXPECT_NE(before.v_world, w.problem.poses[1].state.v_world);
}

TEST_P(Bundle, WorksWhenOnlyPointsOrOnlyPosesAreFree) {
  BundleWorld w = make_bundle_world(rig(), {.poses = 6, .fixed_poses = 6}, 8);
  const BundleResult points_only = adjust_bundle(w.problem, kToTheEnd);
  ASSERT_TRUE(points_only.usable) << points_only.reason;
  EXPECT_LT(points_only.final_cost, 0.2 * points_only.initial_cost);
}

TEST_P(Bundle, IsDeterministic) {
  BundleWorld a = make_bundle_world(rig(), {.outlier_fraction = 0.1, .inertial = true}, 9), b = a;
  const BundleResult ra = adjust_bundle(a.problem), rb = adjust_bundle(b.problem);
  EXPECT_EQ(ra.outlier, rb.outlier);
  EXPECT_EQ(ra.final_cost, rb.final_cost);
  EXPECT_TRUE(a.problem.points == b.problem.points);
}

TEST_P(Bundle, AllSolversFindTheSameOptimum) {
  for (const bool inertial : {false, true}) {
    const BundleWorld start = make_bundle_world(rig(), {.points = 200, .inertial = inertial}, 10);
    double dense_cost = 0;
    for (const BundleSolver solver :
         {BundleSolver::kDense, BundleSolver::kSparse, BundleSolver::kIterative}) {
      BundleWorld w = start;
      const BundleResult result = adjust_bundle(
          w.problem, {.iterations = 40, .iterations_after_gate = 40, .solver = solver});
      ASSERT_TRUE(result.usable) << result.reason;
      EXPECT_LT(worst_position_error(w), 0.05);
      if (solver == BundleSolver::kDense) dense_cost = result.final_cost;
      EXPECT_NEAR(result.final_cost / dense_cost, 1.0, 1e-2);
    }
  }
}

TEST_P(Bundle, ManyPosesAreSolvedBySparseCholesky) {
  BundleWorld w = make_bundle_world(
      rig(), {.poses = 80, .points = 300, .max_observations_of_point = 20, .step_ns = 50'000'000},
      10);
  const BundleResult result = adjust_bundle(w.problem, kToTheEnd);
  ASSERT_TRUE(result.usable) << result.reason;
  EXPECT_LT(worst_position_error(w), 0.06);
}

TEST_P(Bundle, LeavesTheProblemAloneWhenItCannotBeUsed) {
  BundleWorld w = make_bundle_world(rig(), {}, 11);
  BundleProblem empty = w.problem;
  empty.observations.clear();
  BundleResult result = adjust_bundle(empty);
  EXPECT_FALSE(result.usable);
  EXPECT_FALSE(result.reason.empty());

  BundleProblem bad = w.problem;
  bad.poses[3].state.T_world_body.translation.x() = std::numeric_limits<double>::quiet_NaN();
  result = adjust_bundle(bad);
  EXPECT_FALSE(result.usable);
  EXPECT_THAT(result.reason, testing::HasSubstr("pose 3"));
  EXPECT_TRUE(bad.points == w.problem.points);
}

TEST_P(Bundle, TreatsWhatIsNotFiniteOrBehindAsOutlier) {
  BundleWorld w = make_bundle_world(rig(), {}, 12);
  w.problem.observations[0].pixel.left.x() = std::numeric_limits<double>::quiet_NaN();
  const int lost = w.problem.observations[1].point;
  w.problem.points[lost].setConstant(std::numeric_limits<double>::quiet_NaN());
  const SE3 T_world_left = w.truth.poses[0].state.T_world_body * w.problem.rig.T_body_left;
  w.problem.points.push_back(T_world_left * Vector3d(1e-3, 1e-3, -4));
  w.problem.observations.push_back(
      {0, static_cast<int>(w.problem.points.size()) - 1, {{100, 100}}, 1});
  const BundleResult result = adjust_bundle(w.problem, kToTheEnd);
  ASSERT_TRUE(result.usable) << result.reason;
  EXPECT_EQ(result.outlier[0], 1);
  EXPECT_EQ(result.outlier[1], 1);
  EXPECT_EQ(result.outlier.back(), 1);
  EXPECT_LT(worst_position_error(w), 0.03);
}

TEST_P(Bundle, StopsWhenCancelled) {
  BundleWorld w = make_bundle_world(rig(), {}, 13);
  const std::atomic<bool> cancel{true};
  const BundleResult result = adjust_bundle(w.problem, {.cancel = &cancel});
  EXPECT_TRUE(result.cancelled);
  EXPECT_LE(result.iterations, 1);
  for (const BundlePose& p : w.problem.poses) EXPECT_TRUE(p.state.T_world_body.is_finite());
}

TEST_P(Bundle, RejectsBadIndicesAndOptions) {
  BundleWorld w = make_bundle_world(rig(), {.inertial = true}, 14);
  BundleProblem p = w.problem;
  p.observations[5].point = static_cast<int>(p.points.size());
  EXPECT_THROW(adjust_bundle(p), InvalidArgument);
  p = w.problem;
  p.observations[5].pose = -1;
  EXPECT_THROW(adjust_bundle(p), InvalidArgument);
  p = w.problem;
  p.imu_edges[0].imu = nullptr;
  EXPECT_THROW(adjust_bundle(p), InvalidArgument);
  EXPECT_THROW(adjust_bundle(w.problem, {.threads = 0}), InvalidArgument);
  EXPECT_THROW(adjust_bundle(w.problem, {.iterations = -1}), InvalidArgument);
}

INSTANTIATE_TEST_SUITE_P(Rigs, Bundle, testing::Values(false, true));

}  // namespace
}  // namespace fastloop::optimization
