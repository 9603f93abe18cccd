#include "fastloop/optimization/pose_graph.hpp"

#include "fastloop/core/time.hpp"
#include "fastloop/optimization/block_solver.hpp"
#include "fastloop/optimization/pose_graph_baselines.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {

PoseGraphPlan::PoseGraphPlan() : impl_(std::make_unique<Impl>()) {}
PoseGraphPlan::~PoseGraphPlan() = default;
PoseGraphPlan::PoseGraphPlan(PoseGraphPlan&&) noexcept = default;
PoseGraphPlan& PoseGraphPlan::operator=(PoseGraphPlan&&) noexcept = default;

namespace {

void reset(PoseGraphResult& result) {
  result.status = PoseGraphStatus::kConverged;
  result.reason.clear();
  result.initial_cost = result.final_cost = 0;
  result.iterations = result.factorizations = result.components = result.anchored = 0;
  result.cost_history.clear();
  result.rejected.clear();
  result.plan_reused = result.plan_extended = result.on_device = false;
  result.times = PoseGraphTimes();
  result.device = PoseGraphDeviceCounts();
}

}  // namespace

void solve_pose_graph(PoseGraphProblem& problem, const PoseGraphOptions& options,
                      PoseGraphPlan* plan, PoseGraphResult& result) {
  const Stopwatch watch;
  options.validate();
  reset(result);
  std::optional<PoseGraphPlan> temporary;
  const bool cuda = options.solver == PoseGraphSolverKind::kCuda;
  if (plan == nullptr && (cuda || options.solver == PoseGraphSolverKind::kBlock))
    plan = &temporary.emplace();
  if (cuda) {  // checks the problem on its way
    if (plan->impl().solve_on_device(problem, options, result)) {
      result.times.total_ms = watch.elapsed_ms();
      return;
    }
    reset(result);
  }
  if (std::optional<std::string> error = find_pose_graph_error(problem)) {
    result.status = PoseGraphStatus::kInvalidProblem;
    result.reason = std::move(*error);
    return;
  }
  switch (options.solver) {
    case PoseGraphSolverKind::kBlock:
    case PoseGraphSolverKind::kCuda:
      plan->impl().solve(problem, options, result);
      break;
    case PoseGraphSolverKind::kCeres:
      solve_with_ceres(problem, options, result);
      break;
    case PoseGraphSolverKind::kReference:
      solve_with_reference(problem, options, result);
      break;
  }
  result.times.total_ms = watch.elapsed_ms();
}

PoseGraphResult solve_pose_graph(PoseGraphProblem& problem, const PoseGraphOptions& options,
                                 PoseGraphPlan* plan) {
  PoseGraphResult result;
  solve_pose_graph(problem, options, plan, result);
  return result;
}

double pose_graph_cost(const PoseGraphProblem& problem) {
  double sum = 0;
  const int size = residual_size(problem.kind);
  for (const PoseGraphEdge& e : problem.edges) {
    const Vector7d full =
        edge_residual(problem.kind, problem.poses.at(e.from), problem.poses.at(e.to), e.T_from_to);
    const auto r = full.head(size);
    sum += r.dot(problem.information.at(e.information).topLeftCorner(size, size) * r);
  }
  return 0.5 * sum;
}

std::string_view to_string(PoseGraphStatus status) {
  switch (status) {
    case PoseGraphStatus::kConverged:
      return "converged";
    case PoseGraphStatus::kMaxIterations:
      return "max_iterations";
    case PoseGraphStatus::kStalled:
      return "stalled";
    case PoseGraphStatus::kInvalidProblem:
      break;
  }
  return "invalid_problem";
}

std::string_view to_string(PoseGraphSolverKind solver) {
  switch (solver) {
    case PoseGraphSolverKind::kBlock:
      return "block";
    case PoseGraphSolverKind::kCeres:
      return "ceres";
    case PoseGraphSolverKind::kCuda:
      return "cuda";
    case PoseGraphSolverKind::kReference:
      break;
  }
  return "reference";
}

}  // namespace fastloop::optimization
