#include "fastloop/optimization/pose_graph.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"
#include "fastloop/optimization/pose_graph_test_support.hpp"

namespace fastloop::optimization {
namespace {

using testing::disturbed;
using testing::graph_of;
using testing::largest_difference;
using testing::random_graph;
using testing::RandomGraphOptions;
using testing::same_bytes;

constexpr PoseGraphKind kKinds[] = {PoseGraphKind::kYaw, PoseGraphKind::kSe3, PoseGraphKind::kSim3};

class PoseGraphKinds : public ::testing::TestWithParam<PoseGraphKind> {};
INSTANTIATE_TEST_SUITE_P(All, PoseGraphKinds, ::testing::ValuesIn(kKinds), [](const auto& test) {
  return std::string(test.param == PoseGraphKind::kYaw   ? "Yaw"
                     : test.param == PoseGraphKind::kSe3 ? "Se3"
                                                         : "Sim3");
});

TEST_P(PoseGraphKinds, DerivativesAreThoseOfDifferences) {
  testing::Random random(3);
  const PoseGraphKind kind = GetParam();
  const int d = tangent_size(kind, false);
  for (double error : {0.0, 1e-9, 1e-4, 0.1, 0.6, 1.5}) {
    for (int repeat = 0; repeat < 20; ++repeat) {
      const Sim3 from = testing::random_pose(random, kind, 3),
                 to = testing::random_pose(random, kind, 3);
      Vector7d noise = random.tangent(error, error, 0.5 * error);
      if (kind != PoseGraphKind::kSim3) noise[6] = 0;
      if (noise.head<3>().norm() > 2.5) continue;  // at pi the logarithm has no derivative
      const Sim3 z = from.inverse() * to * Sim3::exp(noise);
      const EdgeLinearization l = linearize_edge(kind, from, to, z);
      EXPECT_EQ(l.residual, edge_residual(kind, from, to, z));
      for (int c = 0; c < 7; ++c) {
        const Vector7d step = 1e-6 * Vector7d::Unit(c);
        if (c >= d) {
          EXPECT_EQ(l.jacobian_to.col(c).norm(), 0);
          continue;
        }
        const auto residual = [&](const Sim3& a, const Sim3& b) {
          return edge_residual(kind, a, b, z);
        };
        const Vector7d of_to = (residual(from, move_vertex(kind, to, step)) -
                                residual(from, move_vertex(kind, to, -step))) /
                               2e-6;
        const Vector7d of_from = (residual(move_vertex(kind, from, step), to) -
                                  residual(move_vertex(kind, from, -step), to)) /
                                 2e-6;
        const double tolerance = 2e-7 * (1 + l.jacobian_to.norm());
        EXPECT_LT((l.jacobian_to.col(c) - of_to).norm(), tolerance)
            << "error " << error << " column " << c;
        EXPECT_LT((l.jacobian_to.col(c) + of_from).norm(), tolerance)
            << "error " << error << " column " << c;
      }
    }
  }
}

TEST_P(PoseGraphKinds, ExactMeasurementsGiveTheTruth) {
  testing::Random random(8);
  RandomGraphOptions options;
  options.kind = GetParam();
  options.noise = 0;
  options.poses = 40;
  PoseGraphProblem p = random_graph(random, options);
  const PoseGraphResult r = solve_pose_graph(p);
  EXPECT_EQ(r.status, PoseGraphStatus::kConverged) << r.reason;
  EXPECT_LT(r.final_cost, 1e-18);
  EXPECT_GT(r.initial_cost, 1e-3);
}

TEST_P(PoseGraphKinds, AgreesWithCeresAndReference) {
  for (std::uint64_t seed = 0; seed < 10; ++seed) {
    const PoseGraphProblem start = graph_of(GetParam(), 12 + 5 * static_cast<int>(seed), seed);
    double cost[3];
    for (auto solver : {PoseGraphSolverKind::kBlock, PoseGraphSolverKind::kCeres,
                        PoseGraphSolverKind::kReference}) {
      PoseGraphProblem p = start;
      PoseGraphOptions options;
      options.solver = solver;
      options.relative_tolerance = 1e-9;
      const PoseGraphResult r = solve_pose_graph(p, options);
      EXPECT_TRUE(r.usable());
      EXPECT_NEAR(r.initial_cost, pose_graph_cost(start), 1e-9 * r.initial_cost);
      EXPECT_NEAR(r.final_cost, pose_graph_cost(p), 1e-9 * r.final_cost);
      EXPECT_EQ(r.cost_history.front(), r.initial_cost);
      EXPECT_TRUE(std::is_sorted(r.cost_history.rbegin(), r.cost_history.rend()));
      cost[static_cast<int>(solver)] = r.final_cost;
    }
    EXPECT_LE(cost[0], cost[1] * (1 + 1e-6)) << seed;
    EXPECT_LE(cost[0], cost[2] * (1 + 1e-6)) << seed;
  }
}

TEST(PoseGraph, FixedScaleKeepsScales) {
  PoseGraphProblem p = graph_of(PoseGraphKind::kSim3, 25, 4);
  p.fixed_scale = true;
  const PoseGraphProblem start = p;
  PoseGraphProblem other = p;
  const PoseGraphResult r = solve_pose_graph(p);
  PoseGraphOptions ceres;
  ceres.solver = PoseGraphSolverKind::kCeres;
  ceres.relative_tolerance = 1e-10;
  const PoseGraphResult c = solve_pose_graph(other, ceres);
  EXPECT_LT(r.final_cost, 0.5 * r.initial_cost);
  EXPECT_LE(r.final_cost, c.final_cost * (1 + 1e-6));
  for (std::size_t i = 0; i < p.poses.size(); ++i)
    EXPECT_EQ(p.poses[i].scale, start.poses[i].scale);
}

TEST(PoseGraph, YawKeepsRollAndPitch) {
  PoseGraphProblem p = graph_of(PoseGraphKind::kYaw, 25, 5, 0.3);
  const PoseGraphProblem start = p;
  solve_pose_graph(p);
  for (std::size_t i = 0; i < p.poses.size(); ++i) {
    const Vector3d before = start.poses[i].rotation.conjugate() * Vector3d::UnitZ();
    const Vector3d after = p.poses[i].rotation.conjugate() * Vector3d::UnitZ();
    EXPECT_LT((before - after).norm(), 1e-12);
  }
}

TEST_P(PoseGraphKinds, GaugeInvariance) {
  const PoseGraphKind kind = GetParam();
  PoseGraphProblem p = graph_of(kind, 50, 6), moved = p;
  Sim3 g(so3::exp(Vector3d(0, 0, 2.1)), Vector3d(300, -200, 10), 1);
  if (kind != PoseGraphKind::kYaw) g.rotation = so3::exp(Vector3d(0.7, -1.1, 0.4));
  if (kind == PoseGraphKind::kSim3) g.scale = 1.7;
  for (Sim3& pose : moved.poses) pose = g * pose;
  const PoseGraphResult a = solve_pose_graph(p), b = solve_pose_graph(moved);
  EXPECT_EQ(a.iterations, b.iterations);
  EXPECT_NEAR(a.final_cost, b.final_cost, 1e-9 * a.final_cost);
  for (Sim3& pose : moved.poses) pose = g.inverse() * pose;
  EXPECT_LT(largest_difference(p.poses, moved.poses), 1e-9);
}

TEST_P(PoseGraphKinds, PermutationInvariance) {
  PoseGraphProblem p = graph_of(GetParam(), 60, 7);
  testing::Random random(99);
  std::vector<int> place(p.poses.size());
  std::iota(place.begin(), place.end(), 0);
  for (int i = static_cast<int>(place.size()) - 1; i > 0; --i)
    std::swap(place[i], place[random.integer(i + 1)]);
  PoseGraphProblem q = p;
  for (std::size_t i = 0; i < place.size(); ++i) {
    q.poses[place[i]] = p.poses[i];
    q.fixed[place[i]] = p.fixed[i];
  }
  for (PoseGraphEdge& e : q.edges) {
    e.from = place[e.from];
    e.to = place[e.to];
  }
  for (int i = static_cast<int>(q.edges.size()) - 1; i > 0; --i)
    std::swap(q.edges[i], q.edges[random.integer(i + 1)]);
  const PoseGraphResult a = solve_pose_graph(p), b = solve_pose_graph(q);
  EXPECT_NEAR(a.final_cost, b.final_cost, 1e-9 * a.final_cost);
  std::vector<Sim3> back(p.poses.size());
  for (std::size_t i = 0; i < place.size(); ++i) back[i] = q.poses[place[i]];
  EXPECT_LT(largest_difference(p.poses, back), 1e-9);
}

TEST_P(PoseGraphKinds, AnyNumberOfThreadsGivesTheSameBytes) {
  const PoseGraphProblem start = graph_of(GetParam(), 700, 11);
  PoseGraphProblem first = start;
  const PoseGraphResult a = solve_pose_graph(first);
  for (int threads : {1, 2, 3, 8}) {
    PoseGraphProblem p = start;
    PoseGraphOptions options;
    options.threads = threads;
    const PoseGraphResult b = solve_pose_graph(p, options);
    EXPECT_TRUE(same_bytes(first.poses, p.poses)) << threads << " threads";
    EXPECT_EQ(a.cost_history, b.cost_history) << threads << " threads";
  }
}

/// Edges that share a matrix give the same bytes as edges with equal ones of their own.
TEST_P(PoseGraphKinds, SharedInformationChangesNothing) {
  for (bool full : {false, true}) {
    testing::Random random(16);
    RandomGraphOptions options;
    options.kind = GetParam();
    options.poses = 90;
    options.full_information = full;
    PoseGraphProblem shared = random_graph(random, options);
    for (std::size_t k = 0; k < shared.edges.size(); ++k) shared.edges[k].information = k % 40 == 7;
    PoseGraphProblem own = shared;
    own.information.clear();
    for (PoseGraphEdge& e : own.edges) {
      own.information.push_back(shared.information[static_cast<std::size_t>(e.information)]);
      e.information = static_cast<int>(own.information.size()) - 1;
    }
    const PoseGraphResult a = solve_pose_graph(shared), b = solve_pose_graph(own);
    EXPECT_EQ(a.cost_history, b.cost_history);
    EXPECT_TRUE(same_bytes(shared.poses, own.poses));
    EXPECT_NEAR(a.final_cost, pose_graph_cost(shared), 1e-9 * a.final_cost);
  }
}

TEST(PoseGraph, ComponentsAreAnchored) {
  PoseGraphProblem a = graph_of(PoseGraphKind::kSe3, 15, 21),
                   b = graph_of(PoseGraphKind::kSe3, 12, 22);
  PoseGraphProblem both = a;
  both.poses.insert(both.poses.end(), b.poses.begin(), b.poses.end());
  both.poses.emplace_back(Eigen::Quaterniond::Identity(), Vector3d(7, 7, 7), 1.0);  // without edges
  both.fixed.clear();
  for (PoseGraphEdge e : b.edges) {
    e.from += 15;
    e.to += 15;
    e.information += 5;
    both.edges.push_back(e);
  }
  both.information.insert(both.information.end(), b.information.begin(), b.information.end());
  const Sim3 first = both.poses[0], second = both.poses[15];
  const PoseGraphResult r = solve_pose_graph(both);
  EXPECT_EQ(r.status, PoseGraphStatus::kConverged);
  EXPECT_EQ(r.components, 2);
  EXPECT_EQ(r.anchored, 2);
  EXPECT_EQ(both.poses[0].translation, first.translation);
  EXPECT_EQ(both.poses[15].translation, second.translation);
  EXPECT_EQ(both.poses.back().translation, Vector3d(7, 7, 7));
  // The gauge is free, so each part ends at the cost it has alone.
  const double expected = solve_pose_graph(a).final_cost + solve_pose_graph(b).final_cost;
  EXPECT_NEAR(r.final_cost, expected, 1e-6 * expected);
}

TEST(PoseGraph, DuplicateEdgesCountTwice) {
  PoseGraphProblem p = graph_of(PoseGraphKind::kSim3, 20, 23), doubled = p, heavier = p;
  doubled.edges.insert(doubled.edges.end(), p.edges.begin(), p.edges.end());
  for (auto& w : heavier.information) w *= 2;
  const double a = solve_pose_graph(doubled).final_cost, b = solve_pose_graph(heavier).final_cost;
  EXPECT_NEAR(a, b, 1e-8 * a);
  EXPECT_LT(largest_difference(doubled.poses, heavier.poses), 1e-6);
}

TEST(PoseGraph, BadProblemsAreRefusedWithTheReason) {
  const PoseGraphProblem good = graph_of(PoseGraphKind::kSe3, 10, 24);
  const auto reason = [&](auto damage) {
    std::string text;
    for (auto solver : {PoseGraphSolverKind::kBlock, PoseGraphSolverKind::kCeres,
                        PoseGraphSolverKind::kReference}) {
      PoseGraphProblem p = good;
      damage(p);
      const std::vector<Sim3> before = p.poses;
      PoseGraphOptions options;
      options.solver = solver;
      const PoseGraphResult r = solve_pose_graph(p, options);
      EXPECT_EQ(r.status, PoseGraphStatus::kInvalidProblem);
      EXPECT_FALSE(r.usable());
      EXPECT_FALSE(r.reason.empty());
      for (std::size_t i = 0; i < before.size(); ++i) {
        if (before[i].is_finite()) {
          EXPECT_EQ(before[i].translation, p.poses[i].translation);
        }
      }
      text = r.reason;
    }
    return text;
  };
  const double nan = std::numeric_limits<double>::quiet_NaN(),
               inf = std::numeric_limits<double>::infinity();
  EXPECT_NE(reason([&](auto& p) { p.poses[3].translation.x() = nan; }).find("pose 3"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.poses[4].rotation.coeffs().setZero(); }).find("pose 4"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.poses[2].scale = 0; }).find("pose 2"), std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.edges[5].T_from_to.translation.y() = inf; }).find("edge 5"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.edges[2].to = 10; }).find("10 vertices"), std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.edges[2].from = -1; }).find("edge 2"), std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.edges[1].to = p.edges[1].from; }).find("itself"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.edges[1].information = 5; }).find("missing information"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.information[3](1, 1) = -1; }).find("indefinite"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.information[3](1, 2) += 1; }).find("not symmetric"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.information[0](0, 0) = nan; }).find("not finite"),
            std::string::npos);
  EXPECT_NE(reason([&](auto& p) { p.fixed.resize(3); }).find("fixed"), std::string::npos);
}

TEST(PoseGraph, OptionsAreChecked) {
  PoseGraphProblem p = graph_of(PoseGraphKind::kSe3, 10, 24);
  PoseGraphOptions options;
  options.threads = 0;
  EXPECT_THROW(solve_pose_graph(p, options), InvalidArgument);
  options = {};
  options.relative_tolerance = -1;
  EXPECT_THROW(solve_pose_graph(p, options), InvalidArgument);
  options = {};
  options.robust_width = 0;
  EXPECT_THROW(solve_pose_graph(p, options), InvalidArgument);
}

TEST(PoseGraph, EmptyProblemsAreDone) {
  PoseGraphProblem p;
  EXPECT_EQ(solve_pose_graph(p).status, PoseGraphStatus::kConverged);
  p.poses.resize(3);
  EXPECT_EQ(solve_pose_graph(p).status, PoseGraphStatus::kConverged);
  p.edges.push_back({0, 1, Sim3(Eigen::Quaterniond::Identity(), Vector3d(1, 0, 0), 1), 0, false});
  p.fixed = {1, 1, 0};
  const PoseGraphResult r = solve_pose_graph(p);  // nothing may move
  EXPECT_EQ(r.status, PoseGraphStatus::kConverged);
  EXPECT_DOUBLE_EQ(r.final_cost, 0.5);
}

TEST_P(PoseGraphKinds, ZeroInformationConnectsNothing) {
  PoseGraphProblem p = graph_of(GetParam(), 20, 25);
  p.information.push_back(PoseGraphInformation::Zero());
  p.poses.emplace_back(Eigen::Quaterniond::Identity(), Vector3d(1, 2, 3), 1.0);
  p.fixed.push_back(0);
  PoseGraphProblem without = p;
  p.edges.push_back({3, 20, Sim3(), 5, false});
  for (auto solver : {PoseGraphSolverKind::kBlock, PoseGraphSolverKind::kCeres,
                      PoseGraphSolverKind::kReference}) {
    PoseGraphProblem q = p;
    PoseGraphOptions options;
    options.solver = solver;
    const PoseGraphResult r = solve_pose_graph(q, options);
    EXPECT_TRUE(r.usable());
    EXPECT_EQ(q.poses[20].translation, Vector3d(1, 2, 3));
  }
  EXPECT_NEAR(solve_pose_graph(p).final_cost, solve_pose_graph(without).final_cost, 1e-9);
}

TEST(PoseGraph, SemidefiniteInformationIsDefined) {
  // Positions only: rotations are free up to what positions say, and the matrix is singular.
  PoseGraphProblem p = graph_of(PoseGraphKind::kSe3, 20, 26);
  for (auto& w : p.information) {
    w.topRows<3>().setZero();
    w.leftCols<3>().setZero();
    w = (0.5 * (w + w.transpose())).eval();
  }
  const PoseGraphResult r = solve_pose_graph(p);
  EXPECT_TRUE(r.usable());
  EXPECT_LT(r.final_cost, r.initial_cost);
  for (const Sim3& pose : p.poses) EXPECT_TRUE(pose.is_finite());
}

/// A graph and one loop edge that is far off; `expected` gets the solution without that edge.
PoseGraphProblem graph_with_outlier(PoseGraphKind kind, std::vector<Sim3>& expected) {
  testing::Random random(31);
  RandomGraphOptions options;
  options.kind = kind;
  options.poses = 30;
  options.noise = 0.001;
  options.full_information = false;
  PoseGraphProblem p = random_graph(random, options);
  PoseGraphProblem clean = p;
  solve_pose_graph(clean);
  expected = clean.poses;
  PoseGraphEdge wrong = p.edges.front();
  wrong.from = 2;
  wrong.to = 27;
  wrong.T_from_to.translation = Vector3d(8, 8, 8);
  wrong.switchable = true;
  p.edges.push_back(wrong);
  return p;
}

TEST_P(PoseGraphKinds, RobustKernelsWithstandAWrongLoop) {
  std::vector<Sim3> expected;
  const PoseGraphProblem start = graph_with_outlier(GetParam(), expected);
  PoseGraphProblem plain = start;
  solve_pose_graph(plain);
  const double harm = largest_difference(plain.poses, expected);
  EXPECT_GT(harm, 0.05);
  for (auto kernel :
       {RobustKernel::kHuber, RobustKernel::kCauchy, RobustKernel::kDynamicCovarianceScaling}) {
    double cost[3];
    for (auto solver : {PoseGraphSolverKind::kBlock, PoseGraphSolverKind::kCeres,
                        PoseGraphSolverKind::kReference}) {
      PoseGraphProblem p = start;
      PoseGraphOptions options;
      options.solver = solver;
      options.robust_kernel = kernel;
      options.robust_width = 0.1;
      options.relative_tolerance = 1e-10;
      options.max_iterations = 100;
      const PoseGraphResult r = solve_pose_graph(p, options);
      cost[static_cast<int>(solver)] = r.final_cost;
      if (solver == PoseGraphSolverKind::kBlock) {
        EXPECT_LT(largest_difference(p.poses, expected), 0.2 * harm);
      }
    }
    EXPECT_LE(cost[0], cost[1] * (1 + 1e-6));
    EXPECT_LE(cost[0], cost[2] * (1 + 1e-6));
  }
}

TEST_P(PoseGraphKinds, OutlierLoopsAreRejectedAndNamed) {
  std::vector<Sim3> expected;
  PoseGraphProblem p = graph_with_outlier(GetParam(), expected);
  PoseGraphOptions options;
  options.robust_kernel = RobustKernel::kDynamicCovarianceScaling;
  options.robust_width = 0.1;
  options.rejection_gate = 25;
  const PoseGraphResult r = solve_pose_graph(p, options);
  EXPECT_EQ(r.rejected, std::vector<int>{static_cast<int>(p.edges.size()) - 1});
  EXPECT_LT(largest_difference(p.poses, expected), 1e-4);
}

TEST_P(PoseGraphKinds, NeverEndsHigherThanItBegan) {
  for (std::uint64_t seed = 0; seed < 25; ++seed) {
    PoseGraphProblem p = graph_of(GetParam(), 25, 100 + seed, 1.5);  // far from any minimum
    const double before = pose_graph_cost(p);
    const PoseGraphResult r = solve_pose_graph(p);
    EXPECT_LE(pose_graph_cost(p), before * (1 + 1e-12));
    EXPECT_LE(r.final_cost, r.initial_cost);
    for (const Sim3& pose : p.poses) EXPECT_TRUE(pose.is_finite());
  }
}

}  // namespace
}  // namespace fastloop::optimization
