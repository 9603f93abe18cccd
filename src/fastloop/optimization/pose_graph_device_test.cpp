#include "fastloop/optimization/pose_graph_device.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/optimization/pose_graph_device_edge.hpp"
#include "fastloop/optimization/pose_graph_test_support.hpp"

namespace fastloop::optimization {
namespace {

using testing::graph_of;
using testing::largest_difference;
using testing::Random;
using testing::same_bytes;

constexpr PoseGraphKind kKinds[] = {PoseGraphKind::kYaw, PoseGraphKind::kSe3, PoseGraphKind::kSim3};

/// Where the passes run: on the host with whole fronts, on the host with fronts cut into tiles, on
/// the device.
enum class Place { kHost, kHostTiles, kDevice };

class PoseGraphDevice : public ::testing::TestWithParam<Place> {
 protected:
  void SetUp() override {
    if (GetParam() == Place::kDevice && !CudaSession::process_wide())
      GTEST_SKIP() << "no CUDA device";
  }

  std::unique_ptr<device::Solver> make_solver() const {
    return std::make_unique<device::Solver>(
        GetParam() == Place::kDevice
            ? device::make_cuda_executor()
            : device::make_host_executor(GetParam() == Place::kHost ? 28000 : 300));
  }

  PoseGraphResult solve(PoseGraphProblem& problem, const PoseGraphOptions& options = {}) const {
    PoseGraphResult result;
    make_solver()->solve(problem, options, result);
    return result;
  }

  /// Solves here and with the block solver.
  void expect_agreement(const PoseGraphProblem& start, const PoseGraphOptions& options = {},
                        double pose_tolerance = 1e-6) const {
    PoseGraphProblem here = start, block = start;
    const PoseGraphResult a = solve(here, options), b = solve_pose_graph(block, options);
    EXPECT_EQ(a.status, b.status);
    EXPECT_NEAR(a.initial_cost, b.initial_cost, 1e-9 * b.initial_cost + 1e-18);
    EXPECT_NEAR(a.final_cost, b.final_cost, 1e-6 * b.final_cost + 1e-18);
    EXPECT_LT(largest_difference(here.poses, block.poses), pose_tolerance);
    EXPECT_EQ(a.rejected, b.rejected);
    EXPECT_EQ(a.components, b.components);
    EXPECT_EQ(a.anchored, b.anchored);
    EXPECT_LE(a.final_cost, a.initial_cost);
  }
};
INSTANTIATE_TEST_SUITE_P(All, PoseGraphDevice,
                         ::testing::Values(Place::kHost, Place::kHostTiles, Place::kDevice),
                         [](const auto& test) {
                           return std::string(test.param == Place::kHost        ? "Host"
                                              : test.param == Place::kHostTiles ? "HostTiles"
                                                                                : "Device");
                         });

TEST_P(PoseGraphDevice, AgreesWithTheBlockSolverOnRandomGraphs) {
  for (PoseGraphKind kind : kKinds)
    for (int poses : {2, 3, 17, 64, 150})
      expect_agreement(graph_of(kind, poses, 40 + static_cast<std::uint64_t>(poses)));
}

TEST_P(PoseGraphDevice, AgreesAtFixedScale) {
  PoseGraphProblem p = graph_of(PoseGraphKind::kSim3, 70, 3);
  p.fixed_scale = true;
  expect_agreement(p);
}

TEST_P(PoseGraphDevice, AgreesOnChainsWithLoops) {
  for (PoseGraphKind kind : kKinds) {
    testing::Random random(8);
    testing::RandomGraphOptions options;
    options.kind = kind;
    options.poses = 400;
    options.extra_edges = 0.03;
    options.displacement = 0.01;
    expect_agreement(testing::random_graph(random, options));
  }
}

TEST_P(PoseGraphDevice, FarResidualsNeedDampingAndAgree) {
  // So far off that steps are refused and damping sets in, and residuals reach half turns.
  expect_agreement(graph_of(PoseGraphKind::kYaw, 100, 9, 1.5));
  PoseGraphProblem p = graph_of(PoseGraphKind::kSe3, 40, 11, 0.8), q = p;
  const PoseGraphResult a = solve(p), b = solve_pose_graph(q);
  EXPECT_GT(b.factorizations, b.iterations);  // or the case shows nothing
  EXPECT_NEAR(a.final_cost, b.final_cost, 1e-6 * b.final_cost);
}

TEST_P(PoseGraphDevice, RobustKernelsAndRejectionAgree) {
  for (PoseGraphKind kind : kKinds) {
    PoseGraphProblem p = graph_of(kind, 80, 21);
    Random random(5);
    for (PoseGraphEdge& e : p.edges)
      if (e.switchable && random.uniform() < 0.1)
        e.T_from_to.translation += Vector3d(0.5, -0.3, 0.4);
    for (RobustKernel kernel :
         {RobustKernel::kHuber, RobustKernel::kCauchy, RobustKernel::kDynamicCovarianceScaling}) {
      PoseGraphOptions options;
      options.robust_kernel = kernel;
      options.robust_width = 0.3;
      expect_agreement(p, options, 1e-4);
      options.rejection_gate = 0.5;
      PoseGraphProblem q = p;
      EXPECT_FALSE(solve_pose_graph(q, options).rejected.empty());
      expect_agreement(p, options, 1e-4);
    }
  }
}

TEST_P(PoseGraphDevice, DegenerateGraphs) {
  for (PoseGraphKind kind : kKinds) {
    PoseGraphProblem one = graph_of(kind, 2, 1);
    one.poses.resize(1);
    one.fixed.clear();
    one.edges.clear();
    expect_agreement(one);
    PoseGraphProblem none = one;
    none.poses.clear();
    expect_agreement(none);
    PoseGraphProblem no_anchor = graph_of(kind, 30, 2);
    no_anchor.fixed.clear();
    expect_agreement(no_anchor);
    PoseGraphProblem all_fixed = graph_of(kind, 30, 2);
    all_fixed.fixed.assign(30, 1);
    expect_agreement(all_fixed);
    PoseGraphProblem loose = graph_of(kind, 30, 4);  // vertices without edges
    for (int k = 0; k < 5; ++k) loose.poses.push_back(loose.poses[k]);
    loose.fixed.resize(35, 0);
    expect_agreement(loose);
    PoseGraphProblem doubled = graph_of(kind, 40, 6);  // the same pairs again, in both directions
    for (int k = 0; k < 40; ++k) {
      PoseGraphEdge e = doubled.edges[k];
      doubled.edges.push_back(e);
      std::swap(e.from, e.to);
      e.T_from_to = e.T_from_to.inverse();
      doubled.edges.push_back(e);
    }
    expect_agreement(doubled);
    PoseGraphProblem silent = graph_of(kind, 40, 7);  // information zero
    silent.information.push_back(PoseGraphInformation::Zero());
    for (int k = 60; k < 70; ++k) silent.edges[k].information = 5;
    expect_agreement(silent);
  }
}

TEST_P(PoseGraphDevice, PiecesWithoutConnection) {
  for (PoseGraphKind kind : kKinds) {
    PoseGraphProblem p = graph_of(kind, 90, 13);
    std::erase_if(p.edges, [](const PoseGraphEdge& e) { return e.from / 30 != e.to / 30; });
    expect_agreement(p);
  }
}

TEST_P(PoseGraphDevice, SameBytesEveryTimeAndWithAKeptPlan) {
  for (PoseGraphKind kind : kKinds) {
    const PoseGraphProblem start = graph_of(kind, 200, 12);
    PoseGraphProblem a = start, b = start, c = start;
    PoseGraphResult r;
    const auto solver = make_solver();
    solver->solve(a, {}, r);
    EXPECT_FALSE(r.plan_reused);
    solver->solve(b, {}, r);
    EXPECT_TRUE(r.plan_reused);
    solve(c);
    EXPECT_TRUE(same_bytes(a.poses, b.poses));
    EXPECT_TRUE(same_bytes(a.poses, c.poses));
    // Another graph with the same plan, and back.
    PoseGraphProblem other = graph_of(kind, 50, 14), alone = other;
    solver->solve(other, {}, r);
    EXPECT_FALSE(r.plan_reused);
    solve(alone);
    EXPECT_LT(largest_difference(other.poses, alone.poses), 1e-7);
    PoseGraphProblem again = start;
    solver->solve(again, {}, r);
    EXPECT_FALSE(r.plan_reused);
    EXPECT_LT(largest_difference(a.poses, again.poses), 1e-7);
  }
}

/// A long way with a few edges back, as a map grows: ten vertices more with every call.
TEST_P(PoseGraphDevice, PlanIsExtended) {
  Random random(4);
  PoseGraphProblem p;
  p.kind = PoseGraphKind::kYaw;
  const auto grow = [&](int to) {
    for (int i = static_cast<int>(p.poses.size()); i < to; ++i) {
      p.poses.emplace_back(Eigen::Quaterniond::Identity(), Vector3d(i, 0.1 * random.normal(), 0),
                           1);
      const auto join = [&](int k) {
        p.edges.push_back({k, i,
                           Sim3(Eigen::Quaterniond::Identity(),
                                Vector3d(1.01 * (i - k), 0.1 * random.normal(), 0), 1),
                           0, false});
      };
      for (int k = std::max(0, i - 4); k < i; ++k) join(k);
      if (i % 97 == 96) join(i - 90);
    }
  };
  grow(600);
  const auto solver = make_solver();
  int extended = 0;
  for (int n = 600; n < 700; n += 10) {
    grow(n + 10);
    if (n == 650) std::erase_if(p.edges, [](const PoseGraphEdge& e) { return e.from == 100; });
    PoseGraphProblem here = p, block = p;
    PoseGraphResult r;
    solver->solve(here, {}, r);
    extended += r.plan_extended;
    const PoseGraphResult b = solve_pose_graph(block);
    EXPECT_NEAR(r.final_cost, b.final_cost, 1e-6 * b.final_cost);
    EXPECT_LT(largest_difference(here.poses, block.poses), 1e-6);
  }
  EXPECT_GE(extended, 5);
  EXPECT_LT(extended, 10);  // the first cannot be
}

TEST_P(PoseGraphDevice, BadProblemsAreRefusedAsElsewhere) {
  const PoseGraphProblem good = graph_of(PoseGraphKind::kSe3, 30, 19);
  std::vector<PoseGraphProblem> bad(7, good);
  bad[0].edges[5].to = 30;
  bad[1].edges[6].from = -1;
  bad[2].edges[7].T_from_to.translation[1] = std::numeric_limits<double>::quiet_NaN();
  bad[3].poses[29].scale = 0;
  bad[4].information[2](0, 0) = -1;
  bad[5].fixed.resize(29);
  bad[6].edges[3].information = 5;
  for (PoseGraphProblem& p : bad) {
    const PoseGraphProblem before = p;
    const auto solver = make_solver();
    PoseGraphProblem first = good;
    PoseGraphResult r;
    solver->solve(first, {}, r);  // with and without a plan that seems to fit
    for (int k = 0; k < 2; ++k) {
      r = PoseGraphResult();
      if (k == 0) solver->solve(p, {}, r);
      if (k == 1) r = solve(p);
      EXPECT_EQ(r.status, PoseGraphStatus::kInvalidProblem);
      EXPECT_EQ(r.reason, find_pose_graph_error(p).value_or("none"));
    }
    PoseGraphProblem again = good;
    r = PoseGraphResult();
    solver->solve(again, {}, r);
    EXPECT_TRUE(r.plan_reused);
    EXPECT_TRUE(same_bytes(again.poses, first.poses));
  }
}

TEST_P(PoseGraphDevice, GrowingGraphs) {
  const PoseGraphProblem whole = graph_of(PoseGraphKind::kSim3, 150, 14);
  const auto solver = make_solver();
  for (int n : {60, 110, 111, 150}) {
    PoseGraphProblem part = whole;
    part.poses.resize(n);
    part.fixed.assign(n, 0);
    part.fixed[0] = 1;
    std::erase_if(part.edges, [n](const PoseGraphEdge& e) { return std::max(e.from, e.to) >= n; });
    PoseGraphProblem block = part;
    PoseGraphResult r;
    solver->solve(part, {}, r);
    const PoseGraphResult b = solve_pose_graph(block);
    EXPECT_NEAR(r.final_cost, b.final_cost, 1e-6 * b.final_cost);
    EXPECT_LT(largest_difference(part.poses, block.poses), 1e-6);
  }
}

TEST(PoseGraphDeviceMath, LinearizationIsThatOfTheReference) {
  Random random(17);
  for (PoseGraphKind kind : kKinds) {
    for (double spread : {0.0, 1e-7, 0.05, 1.0, 2.5}) {
      for (int repeat = 0; repeat < 20; ++repeat) {
        const Sim3 from = testing::random_pose(random, kind, 3),
                   to = testing::random_pose(random, kind, 3);
        Vector7d noise = random.tangent(spread, spread, 0.5 * spread);
        if (kind != PoseGraphKind::kSim3) noise[6] = 0;
        const Sim3 z = from.inverse() * to * Sim3::exp(noise);
        const EdgeLinearization expected = linearize_edge(kind, from, to, z);
        if (expected.residual.head<3>().norm() > 3)
          continue;  // near the half turn it is not smooth
        double p[3][8], j[7][7] = {};
        const Sim3* poses[3] = {&from, &to, &z};
        for (int k = 0; k < 3; ++k) {
          const Sim3& x = *poses[k];
          device::store_pose({{x.rotation.x(), x.rotation.y(), x.rotation.z(), x.rotation.w()},
                              {x.translation.x(), x.translation.y(), x.translation.z()},
                              x.scale},
                             p[k]);
        }
        const block::EdgeModel model = kind == PoseGraphKind::kYaw   ? block::EdgeModel::kYaw
                                       : kind == PoseGraphKind::kSe3 ? block::EdgeModel::kSe3
                                                                     : block::EdgeModel::kSim3;
        device::Linearization l{};
        const auto run = [&]<block::EdgeModel M>() {
          l = device::linearize<M>(device::load_pose(p[0]), device::load_pose(p[1]),
                                   device::load_pose(p[2]));
          device::dense_derivative<M>(l, j);
        };
        if (model == block::EdgeModel::kYaw) run.operator()<block::EdgeModel::kYaw>();
        if (model == block::EdgeModel::kSe3) run.operator()<block::EdgeModel::kSe3>();
        if (model == block::EdgeModel::kSim3) run.operator()<block::EdgeModel::kSim3>();
        const Vector7d residual = (Vector7d() << l.rotation.x, l.rotation.y, l.rotation.z,
                                   l.translation.x, l.translation.y, l.translation.z, l.scale)
                                      .finished();
        EXPECT_LT((residual - expected.residual).norm(), 1e-11 * (1 + expected.residual.norm()));
        const Matrix7d jacobian = Eigen::Map<const Matrix7d>(&j[0][0]);
        EXPECT_LT((jacobian - expected.jacobian_to).norm(),
                  1e-8 * (1 + expected.jacobian_to.norm()));
      }
    }
  }
}

/// Every vertex once, children before parents, no edge between two branches.
void expect_dissection_of(const block::Graph& graph, const device::Dissection& d) {
  const int n = graph.size();
  std::vector<int> node(n, -1);
  for (int k = 0; k < d.size(); ++k) {
    EXPECT_TRUE(d.parent[k] < 0 || d.parent[k] > k);
    EXPECT_LT(d.begin[k], d.begin[k + 1]);
    for (int i = d.begin[k]; i < d.begin[k + 1]; ++i) node[d.vertices[i]] = k;
  }
  EXPECT_EQ(std::count(node.begin(), node.end(), -1), 0);
  EXPECT_EQ(static_cast<int>(d.vertices.size()), n);
  for (int v = 0; v < n; ++v) {
    for (int k = graph.begin[v]; k < graph.begin[v + 1]; ++k) {
      int low = std::min(node[v], node[graph.neighbour[k]]);
      const int high = std::max(node[v], node[graph.neighbour[k]]);
      while (low >= 0 && low < high) low = d.parent[low];
      EXPECT_EQ(low, high) << "an edge joins two branches";
    }
  }
}

block::Graph random_sparse_graph(Random& random, int n, double density) {
  std::vector<int> ends;
  for (int k = 1; k < n; ++k)
    if (density > 0 || k % 3 != 0) ends.insert(ends.end(), {k - 1, k});
  for (int k = 0; k < density * n; ++k)
    ends.insert(ends.end(), {random.integer(n), random.integer(n)});
  block::Graph graph;
  block::build_graph(n, ends, graph);
  return graph;
}

TEST(PoseGraphDissection, SeparatesEveryGraph) {
  Random random(23);
  for (int n : {0, 1, 2, 9, 100, 700}) {
    for (double density : {0.0, 0.05, 1.0}) {
      const block::Graph graph = random_sparse_graph(random, n, density);
      expect_dissection_of(graph, device::dissect(graph, 6));
    }
  }
}

TEST(PoseGraphDissection, LeavesWithManyNeighboursAreCut) {
  Random random(31);
  int larger = 0;
  for (int repeat = 0; repeat < 10; ++repeat) {
    const block::Graph graph = random_sparse_graph(random, 300, 0.01);
    const device::Dissection free = device::dissect(graph, 12), cut = device::dissect(graph, 12, 8);
    expect_dissection_of(graph, cut);
    EXPECT_GE(cut.size(), free.size());
    larger += cut.size() > free.size();
  }
  EXPECT_GT(larger, 5);
}

TEST(PoseGraphDissection, ExtensionSeparatesTheNewGraph) {
  Random random(29);
  int extended = 0;
  for (int repeat = 0; repeat < 60; ++repeat) {
    const int n = 20 + random.integer(200), more = random.integer(30);
    const device::Dissection old = device::dissect(random_sparse_graph(random, n, 0.03), 6);
    // Other edges, a few vertices gone, others come.
    const block::Graph graph = random_sparse_graph(random, n + more, 0.05);
    std::vector<int> node_of(n + more, -1);
    for (int k = 0; k < old.size(); ++k)
      for (int i = old.begin[k]; i < old.begin[k + 1]; ++i)
        if (i % 17 != 3) node_of[old.vertices[i]] = k;
    device::Dissection now;
    if (!device::extend_dissection(graph, node_of, old.parent, 6, now)) continue;
    ++extended;
    expect_dissection_of(graph, now);
  }
  EXPECT_GT(extended, 30);
}

TEST(PoseGraphDissection, TreesOfChainsAreLow) {
  std::vector<int> ends;
  const int n = 4000;
  for (int k = 0; k < n; ++k)
    for (int d = 1; d <= 5 && k + d < n; ++d) ends.insert(ends.end(), {k, k + d});
  block::Graph graph;
  block::build_graph(n, ends, graph);
  const device::Dissection d = device::dissect(graph, 12);
  std::vector<int> depth(d.size(), 1);
  for (int k = d.size() - 1; k >= 0; --k)
    if (d.parent[k] >= 0) depth[k] = depth[d.parent[k]] + 1;
  EXPECT_LE(*std::max_element(depth.begin(), depth.end()), 13);
}

TEST(PoseGraphCuda, WithoutADeviceTheBlockSolverAnswers) {
  PoseGraphProblem p = graph_of(PoseGraphKind::kSe3, 60, 31), q = p;
  PoseGraphOptions options;
  options.solver = PoseGraphSolverKind::kCuda;
  const PoseGraphResult a = solve_pose_graph(p, options), b = solve_pose_graph(q);
  EXPECT_EQ(a.status, PoseGraphStatus::kConverged);
  EXPECT_NEAR(a.final_cost, b.final_cost, 1e-6 * b.final_cost);
  EXPECT_EQ(a.on_device, CudaSession::process_wide() != nullptr);
  EXPECT_TRUE(a.on_device || same_bytes(p.poses, q.poses));
}

TEST(PoseGraphCuda, AFailureOnTheDeviceIsFinishedByTheBlockSolver) {
  const auto session = CudaSession::process_wide();
  if (!session) GTEST_SKIP() << "no CUDA device";
  PoseGraphOptions options;
  options.solver = PoseGraphSolverKind::kCuda;
  for (int n : {1, 3, 8, 15}) {
    PoseGraphProblem p = graph_of(PoseGraphKind::kYaw, 60, 32), q = p;
    PoseGraphPlan plan;
    session->inject_failure(n, false);
    const PoseGraphResult a = solve_pose_graph(p, options, &plan);
    EXPECT_FALSE(a.on_device);
    const PoseGraphResult b = solve_pose_graph(q);
    EXPECT_TRUE(same_bytes(p.poses, q.poses));
    EXPECT_EQ(a.cost_history.size(), b.cost_history.size());
    PoseGraphProblem again = graph_of(PoseGraphKind::kYaw, 60, 32);
    EXPECT_TRUE(solve_pose_graph(again, options, &plan).on_device);
  }
}

TEST(PoseGraphCuda, AKeptPlanNeedsFewHostWaitsAndNoMemory) {
  const auto session = CudaSession::process_wide();
  if (!session) GTEST_SKIP() << "no CUDA device";
  PoseGraphOptions options;
  options.solver = PoseGraphSolverKind::kCuda;
  PoseGraphPlan plan;
  const PoseGraphProblem start = graph_of(PoseGraphKind::kSim3, 300, 33);
  for (int k = 0; k < 2; ++k) {
    PoseGraphProblem p = start;
    solve_pose_graph(p, options, &plan);
  }
  PoseGraphProblem p = start;
  const CudaCounters before = session->counters();
  const PoseGraphResult r = solve_pose_graph(p, options, &plan);
  const CudaCounters after = session->counters();
  EXPECT_TRUE(r.plan_reused);
  EXPECT_EQ(after.allocations, before.allocations);
  // One for the first cost, one for every step, one for the poses.
  const auto steps = static_cast<std::uint64_t>(r.factorizations) + r.cost_history.size();
  EXPECT_LE(after.synchronizations - before.synchronizations, 2 + steps);
  EXPECT_LE(after.launches - before.launches, 1 + 3 * steps);
}

}  // namespace
}  // namespace fastloop::optimization
