#include "fastloop/optimization/block_kernels.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <vector>

#include "fastloop/optimization/block_plan.hpp"
#include "fastloop/optimization/block_solver.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"
#include "fastloop/optimization/pose_graph_test_support.hpp"

namespace fastloop::optimization {
namespace {

using testing::largest_difference;
using testing::random_graph;
using testing::RandomGraphOptions;

struct Model {
  PoseGraphKind kind;
  bool fixed_scale;
};
constexpr Model kModels[] = {{PoseGraphKind::kYaw, false},
                             {PoseGraphKind::kSe3, false},
                             {PoseGraphKind::kSim3, false},
                             {PoseGraphKind::kSim3, true}};

/// Every instruction set finds the minimum that Ceres finds with the scalar residuals and
/// derivatives, from near (power series) and far (exact fallback) starts, with diagonal and full
/// information.
TEST(BlockKernels, EverySetSolvesEveryModel) {
  for (const Model& model : kModels) {
    for (bool full : {false, true}) {
      for (double displacement : {0.02, 0.4}) {
        testing::Random random(17);
        RandomGraphOptions graph;
        graph.kind = model.kind;
        graph.poses = 45;
        graph.displacement = displacement;
        graph.full_information = full;
        PoseGraphProblem start = random_graph(random, graph);
        start.fixed_scale = model.fixed_scale;
        PoseGraphOptions options;
        options.relative_tolerance = 1e-11;
        options.max_iterations = 200;
        PoseGraphProblem by_ceres = start;
        PoseGraphOptions ceres = options;
        ceres.solver = PoseGraphSolverKind::kCeres;
        ceres.initial_trust_region_radius = 1e4;
        const double expected = solve_pose_graph(by_ceres, ceres).final_cost;
        for (const block::KernelSet* set : block::usable_kernels()) {
          PoseGraphProblem p = start;
          PoseGraphPlan plan;
          plan.impl().use_kernels(*set);
          const PoseGraphResult r = solve_pose_graph(p, options, &plan);
          EXPECT_LE(r.final_cost, expected * (1 + 1e-8))
              << set->name << " displacement " << displacement;
          EXPECT_NEAR(r.final_cost, pose_graph_cost(p), 1e-10 * r.final_cost) << set->name;
          if (displacement < 0.1) {
            EXPECT_LT(largest_difference(p.poses, by_ceres.poses), 1e-4) << set->name;
          }
        }
      }
    }
  }
}

/// One batch of edges with errors from nothing to beyond the reach of the series.
TEST(BlockKernels, LinearizationIsThatOfOneEdgeAtATime) {
  testing::Random random(4);
  for (const Model& model : kModels) {
    const int d = tangent_size(model.kind, model.fixed_scale), size = residual_size(model.kind);
    for (double error : {0.0, 1e-8, 1e-3, 0.1, 0.3, 1.0}) {
      std::vector<double> poses, measurement(8 * block::kLanes), information(7 * block::kLanes),
          robust(block::kLanes, 0.0);
      std::vector<std::int32_t> from, to;
      std::vector<EdgeLinearization> expected;
      std::vector<Vector7d> weights;
      const auto push_pose = [&](const Sim3& x) {
        poses.insert(poses.end(),
                     {x.rotation.x(), x.rotation.y(), x.rotation.z(), x.rotation.w(),
                      x.translation.x(), x.translation.y(), x.translation.z(), x.scale});
      };
      for (int lane = 0; lane < block::kLanes; ++lane) {
        const Sim3 a = testing::random_pose(random, model.kind, 5),
                   b = testing::random_pose(random, model.kind, 5);
        Vector7d noise = random.tangent(error, error, 0.5 * error);
        if (model.kind != PoseGraphKind::kSim3) noise[6] = 0;
        const Sim3 z = a.inverse() * b * Sim3::exp(noise);
        push_pose(a);
        push_pose(b);
        from.push_back(2 * lane);
        to.push_back(2 * lane + 1);
        Sim3 stored = z.inverse();
        if (model.kind == PoseGraphKind::kYaw) stored.translation = z.translation;
        const double fields[8] = {stored.rotation.x(),    stored.rotation.y(),
                                  stored.rotation.z(),    stored.rotation.w(),
                                  stored.translation.x(), stored.translation.y(),
                                  stored.translation.z(), stored.scale};
        for (int f = 0; f < 8; ++f) measurement[f * block::kLanes + lane] = fields[f];
        Vector7d w = Vector7d::Zero();
        for (int r = 0; r < size; ++r)
          information[r * block::kLanes + lane] = w[r] = 0.5 + random.uniform();
        weights.push_back(w);
        expected.push_back(linearize_edge(model.kind, a, b, z));
      }
      const std::uint8_t full = 0;
      const std::size_t offset = 0;
      block::PassContext context;
      context.poses = poses.data();
      context.edges = {from.data(), to.data(),          measurement.data(), &full,
                       &offset,     information.data(), robust.data()};
      context.exact_edge = [](block::EdgeModel m, const double* x, const double* y,
                              const double* packed, double* e, double* j) {
        const auto pose = [](const double* p) {
          return Sim3(Eigen::Quaterniond(p[3], p[0], p[1], p[2]), Vector3d(p[4], p[5], p[6]), p[7]);
        };
        Sim3 z = pose(packed).inverse();
        const bool yaw = m == block::EdgeModel::kYaw;
        if (yaw) z.translation = pose(packed).translation;
        const EdgeLinearization l =
            linearize_edge(yaw ? PoseGraphKind::kYaw : PoseGraphKind::kSim3, pose(x), pose(y), z);
        Eigen::Map<Vector7d>(e, 7) = l.residual;
        Eigen::Map<Matrix7d>(j, 7, 7) = l.jacobian_to;
      };
      const int index = model.kind == PoseGraphKind::kYaw   ? 0
                        : model.kind == PoseGraphKind::kSe3 ? 1
                        : model.fixed_scale                 ? 3
                                                            : 2;
      for (const block::KernelSet* set : block::usable_kernels()) {
        block::BatchCursor cursor;
        set->model[index].linearize(context, cursor, 0);
        double cost = 0;
        for (int lane = 0; lane < block::kLanes; ++lane) {
          const Matrix7d& j = expected[lane].jacobian_to;
          const Matrix7d h = j.transpose() * weights[lane].asDiagonal() * j;
          const Vector7d g = j.transpose() * weights[lane].asDiagonal() * expected[lane].residual;
          for (int r = 0; r < d; ++r) {
            EXPECT_NEAR(cursor.gradient[r * block::kLanes + lane], g[r], 1e-9 * (1 + g.norm()))
                << set->name;
            for (int c = 0; c <= r; ++c)
              EXPECT_NEAR(cursor.hessian[(r * (r + 1) / 2 + c) * block::kLanes + lane], h(r, c),
                          1e-9 * (1 + h.norm()))
                  << set->name << " error " << error;
          }
          cost += expected[lane].residual.dot(weights[lane].asDiagonal() * expected[lane].residual);
        }
        std::vector<double> squared(block::kLanes);
        EXPECT_NEAR(set->model[index].cost(context, 0, 1, squared.data()), cost,
                    1e-12 * (1 + cost));
      }
    }
  }
}

/// The symbolic structure holds every entry of a dense elimination, and tasks cover all fronts in a
/// valid order.
TEST(SymbolicPlan, CoversTheFillOfADenseElimination) {
  testing::Random random(6);
  for (int n : {1, 2, 7, 30, 120}) {
    std::vector<int> ends;
    for (int i = 1; i < n; ++i)
      ends.insert(ends.end(), {i, std::max(0, i - 1 - random.integer(3))});
    for (int k = 0; k < n / 4; ++k) ends.insert(ends.end(), {random.integer(n), random.integer(n)});
    block::Graph graph;
    block::build_graph(n, ends, graph);
    block::SymbolicPlan plan;
    block::Passes passes;
    block::build_symbolic_plan(graph, block::minimum_degree_order(graph), 6, passes, plan);
    // Dense boolean elimination in the same order.
    std::vector<std::vector<char>> filled(n, std::vector<char>(n, 0));
    for (int v = 0; v < n; ++v)
      for (int k = graph.begin[v]; k < graph.begin[v + 1]; ++k)
        filled[plan.position[v]][plan.position[graph.neighbour[k]]] = 1;
    for (int j = 0; j < n; ++j)
      for (int r = j + 1; r < n; ++r)
        for (int c = j + 1; c < n; ++c)
          if (filled[r][j] && filled[c][j]) filled[r][c] = 1;
    int eliminated = 0;
    for (std::size_t k = 0; k < plan.fronts.size(); ++k) {
      const block::Front& f = plan.fronts[k];
      EXPECT_EQ(f.first, eliminated);
      eliminated += f.pivots;
      for (int j = f.first; j < f.first + f.pivots; ++j)
        for (int r = f.first + f.pivots; r < n; ++r) {
          const auto rows = plan.rows.begin() + static_cast<std::ptrdiff_t>(f.rows);
          EXPECT_TRUE(!filled[r][j] || std::binary_search(rows, rows + f.below, r));
        }
      if (f.below > 0) {
        ASSERT_GT(f.parent, static_cast<int>(k));
        const block::Front& p = plan.fronts[f.parent];
        for (int r = 0; r < f.below; ++r) {
          const int at = plan.position_in_parent[f.rows + r];
          EXPECT_EQ(plan.rows[f.rows + r],
                    at < p.pivots ? p.first + at : plan.rows[p.rows + at - p.pivots]);
        }
      }
    }
    EXPECT_EQ(eliminated, n);
    std::vector<int> seen(plan.fronts.size(), 0), done(plan.fronts.size(), 0);
    for (const block::Task& t : plan.tasks) {
      for (std::size_t i = t.begin; i < t.end; ++i) {
        const int k = plan.task_fronts[i];
        ++seen[k];
        const block::Front& f = plan.fronts[k];
        for (int c = 0; c < f.num_children; ++c) EXPECT_TRUE(done[plan.children[f.children + c]]);
        done[k] = 1;
      }
    }
    EXPECT_EQ(seen, std::vector<int>(plan.fronts.size(), 1));
  }
}

}  // namespace
}  // namespace fastloop::optimization
