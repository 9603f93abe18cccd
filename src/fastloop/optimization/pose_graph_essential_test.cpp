#include "fastloop/optimization/pose_graph_essential.hpp"

#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"

namespace fastloop::optimization {
namespace {

TEST(EssentialGraph, OneBuilderForAllKinds) {
  std::vector<Sim3> before, after;
  EssentialGraph graph;
  for (int i = 0; i < 20; ++i) {
    before.emplace_back(so3::exp(Vector3d(0, 0, 0.3 * i)), Vector3d(i, 0.1 * i * i, 0), 1.0);
    after.push_back(before.back());
    if (i > 0) graph.chain.emplace_back(i, i - 1);
    if (i > 0) graph.parent.emplace_back(i, i - 1);  // the same pairs again
    if (i > 1) graph.covisible.emplace_back(i - 2, i);
  }
  after.back().translation += Vector3d(0.5, 0.5, 0);
  graph.new_loops.emplace_back(19, 0);
  graph.old_loops.emplace_back(0, 19);  // superseded
  for (auto kind : {PoseGraphKind::kYaw, PoseGraphKind::kSe3, PoseGraphKind::kSim3}) {
    PoseGraphProblem p = build_essential_graph_problem(kind, false, before, after, graph, 0);
    ASSERT_EQ(p.edges.size(), 1u + 19u + 18u);
    EXPECT_TRUE(p.edges[0].switchable);
    EXPECT_FALSE(p.edges[1].switchable);
    // The new loop agrees with the corrected poses, the chain with the old ones.
    EXPECT_LT((p.edges[0].T_from_to.translation - (after[19].inverse() * after[0]).translation).norm(), 1e-12);
    EXPECT_LT((p.edges[1].T_from_to.translation - (before[1].inverse() * before[0]).translation).norm(), 1e-12);
    const PoseGraphResult r = solve_pose_graph(p);
    EXPECT_EQ(r.status, PoseGraphStatus::kConverged);
    EXPECT_LT(r.final_cost, r.initial_cost);
    EXPECT_EQ(p.poses[0].translation, after[0].translation);
  }
  EXPECT_THROW(build_essential_graph_problem(PoseGraphKind::kSe3, false, before, {}, graph, 0), InvalidArgument);
  EXPECT_THROW(build_essential_graph_problem(PoseGraphKind::kSe3, false, before, after, graph, 20), InvalidArgument);
  graph.covisible.emplace_back(3, 99);
  EXPECT_THROW(build_essential_graph_problem(PoseGraphKind::kSe3, false, before, after, graph, 0), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::optimization
