#include <gtest/gtest.h>

#include "fastloop/optimization/pose_graph.hpp"
#include "fastloop/optimization/pose_graph_test_support.hpp"

namespace fastloop::optimization {
namespace {

/// 500 random graphs of all kinds: the three solvers agree to 1e-6, or the block solver is lower.
TEST(PoseGraphSlow, FiveHundredRandomGraphs) {
  int lower = 0;
  for (int k = 0; k < 500; ++k) {
    testing::Random random(1000 + k);
    testing::RandomGraphOptions graph;
    graph.kind = k % 4 == 0   ? PoseGraphKind::kYaw
                 : k % 4 == 1 ? PoseGraphKind::kSe3
                              : PoseGraphKind::kSim3;
    graph.poses = 3 + random.integer(60);
    graph.extra_edges = 2 * random.uniform();
    graph.noise = 0.05 * random.uniform();
    graph.displacement = 0.3 * random.uniform();
    graph.full_information = random.uniform() < 0.5;
    PoseGraphProblem start = random_graph(random, graph);
    start.fixed_scale = k % 4 == 3;
    double cost[3];
    for (auto solver : {PoseGraphSolverKind::kBlock, PoseGraphSolverKind::kCeres,
                        PoseGraphSolverKind::kReference}) {
      PoseGraphProblem p = start;
      PoseGraphOptions options;
      options.solver = solver;
      options.relative_tolerance = solver == PoseGraphSolverKind::kBlock ? 1e-7 : 1e-12;
      options.max_iterations = 200;
      cost[static_cast<int>(solver)] = solve_pose_graph(p, options).final_cost;
    }
    const double tolerance = 1e-6 * cost[0] + 1e-12;
    EXPECT_LE(cost[0], cost[1] + tolerance) << "graph " << k;
    EXPECT_LE(cost[0], cost[2] + tolerance) << "graph " << k;
    if (cost[0] < std::min(cost[1], cost[2]) - tolerance) ++lower;
  }
  RecordProperty("block_lower_than_both", lower);
}

}  // namespace
}  // namespace fastloop::optimization
