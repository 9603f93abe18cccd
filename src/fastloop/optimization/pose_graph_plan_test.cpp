#include <gtest/gtest.h>

#include <algorithm>

#include "fastloop/optimization/pose_graph.hpp"
#include "fastloop/optimization/pose_graph_test_support.hpp"

namespace fastloop::optimization {
namespace {

using testing::graph_of;
using testing::largest_difference;
using testing::same_bytes;

constexpr PoseGraphKind kKinds[] = {PoseGraphKind::kYaw, PoseGraphKind::kSe3, PoseGraphKind::kSim3};

class PoseGraphPlans : public ::testing::TestWithParam<PoseGraphKind> {};
INSTANTIATE_TEST_SUITE_P(All, PoseGraphPlans, ::testing::ValuesIn(kKinds), [](const auto& test) {
  return std::string(test.param == PoseGraphKind::kYaw   ? "Yaw"
                     : test.param == PoseGraphKind::kSe3 ? "Se3"
                                                         : "Sim3");
});

TEST_P(PoseGraphPlans, KeptPlanChangesNothing) {
  const PoseGraphProblem start = graph_of(GetParam(), 80, 12);
  PoseGraphPlan plan;
  PoseGraphProblem a = start, b = start, c = start;
  EXPECT_FALSE(solve_pose_graph(a, {}, &plan).plan_reused);
  EXPECT_TRUE(solve_pose_graph(b, {}, &plan).plan_reused);
  solve_pose_graph(c);
  EXPECT_TRUE(same_bytes(a.poses, b.poses));
  EXPECT_TRUE(same_bytes(a.poses, c.poses));
  // Another graph with the same plan starts afresh and is right, too.
  PoseGraphProblem other = graph_of(GetParam(), 33, 13), alone = other;
  const PoseGraphResult r = solve_pose_graph(other, {}, &plan);
  EXPECT_FALSE(r.plan_reused || r.plan_extended);
  solve_pose_graph(alone);
  EXPECT_TRUE(same_bytes(other.poses, alone.poses));
}

TEST_P(PoseGraphPlans, PlanIsExtended) {
  const PoseGraphProblem whole = graph_of(GetParam(), 150, 14);
  PoseGraphPlan plan;
  for (int n : {100, 110, 120, 150}) {
    PoseGraphProblem part = whole;
    part.poses.resize(n);
    part.fixed.assign(n, 0);
    part.fixed[0] = 1;
    // Edges in the order in which a map would add them.
    std::stable_sort(part.edges.begin(), part.edges.end(),
                     [](const PoseGraphEdge& a, const PoseGraphEdge& b) {
                       return std::max(a.from, a.to) < std::max(b.from, b.to);
                     });
    std::erase_if(part.edges, [n](const PoseGraphEdge& e) { return std::max(e.from, e.to) >= n; });
    PoseGraphProblem fresh = part;
    const PoseGraphResult with_plan = solve_pose_graph(part, {}, &plan);
    EXPECT_FALSE(with_plan.plan_reused);
    const PoseGraphResult without = solve_pose_graph(fresh);
    EXPECT_NEAR(with_plan.final_cost, without.final_cost, 1e-9 * without.final_cost);
    EXPECT_LT(largest_difference(part.poses, fresh.poses), 1e-8);
  }
}

TEST(PoseGraph, PlanExtensionIsReported) {
  PoseGraphProblem p;
  p.kind = PoseGraphKind::kSe3;
  for (int i = 0; i < 200; ++i) {
    p.poses.emplace_back(Eigen::Quaterniond::Identity(), Vector3d(i, 0, 0), 1);
    for (int k = std::max(0, i - 3); k < i; ++k)
      p.edges.push_back({k, i,
                         Sim3(Eigen::Quaterniond::Identity(), Vector3d(1.01 * (i - k), 0, 0), 1), 0,
                         false});
  }
  PoseGraphProblem part = p;
  part.poses.resize(190);
  std::erase_if(part.edges, [](const PoseGraphEdge& e) { return e.to >= 190; });
  PoseGraphPlan plan;
  solve_pose_graph(part, {}, &plan);
  PoseGraphProblem fresh = p;
  const PoseGraphResult r = solve_pose_graph(p, {}, &plan);
  EXPECT_TRUE(r.plan_extended);
  EXPECT_NEAR(r.final_cost, solve_pose_graph(fresh).final_cost, 1e-9);
}

TEST_P(PoseGraphPlans, PlanServesAGraphWhoseEdgesChanged) {
  PoseGraphPlan plan;
  PoseGraphProblem before = graph_of(GetParam(), 120, 15), after = before;
  solve_pose_graph(before, {}, &plan);
  after.edges.erase(after.edges.begin() + 150, after.edges.begin() + 153);
  std::swap(after.edges[10], after.edges[140]);
  PoseGraphProblem fresh = after;
  const PoseGraphResult kept = solve_pose_graph(after, {}, &plan);
  EXPECT_TRUE(kept.plan_extended);
  EXPECT_FALSE(kept.plan_reused);
  EXPECT_NEAR(kept.final_cost, solve_pose_graph(fresh).final_cost, 1e-9 * kept.final_cost);
  EXPECT_LT(largest_difference(after.poses, fresh.poses), 1e-8);
}

}  // namespace
}  // namespace fastloop::optimization
