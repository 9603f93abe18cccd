#include "fastloop/optimization/pose_graph_device.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "fastloop/core/logging.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/optimization/pose_graph_device_edge.hpp"
#include "fastloop/optimization/pose_graph_iteration.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization::device {
namespace {

block::EdgeModel model_of(const PoseGraphProblem& problem) {
  switch (problem.kind) {
    case PoseGraphKind::kYaw:
      return block::EdgeModel::kYaw;
    case PoseGraphKind::kSe3:
      return block::EdgeModel::kSe3;
    case PoseGraphKind::kSim3:
      break;
  }
  return problem.fixed_scale ? block::EdgeModel::kSim3FixedScale : block::EdgeModel::kSim3;
}

int model_tangent(block::EdgeModel model) {
  if (model == block::EdgeModel::kYaw) return 4;
  return model == block::EdgeModel::kSim3 ? 7 : 6;
}

bool fixed_at(const PoseGraphProblem& problem, std::size_t i) {
  return !problem.fixed.empty() && problem.fixed[i] != 0;
}

void put(const Sim3& pose, double* p) {
  p[0] = pose.rotation.x();
  p[1] = pose.rotation.y();
  p[2] = pose.rotation.z();
  p[3] = pose.rotation.w();
  p[4] = pose.translation.x();
  p[5] = pose.translation.y();
  p[6] = pose.translation.z();
  p[7] = pose.scale;
}

/// Poses or edges that one thread walks over at a time.
constexpr std::size_t kWalk = 4096;

/// Vertices of a leaf: more means fewer levels and more arithmetic.
int leaf_size(int block_size) {
  return block_size == 4 ? 16 : 12;
}

/// Blocks of a leaf's front: two such fronts fit into the shared memory of a multiprocessor.
int max_front(int block_size) {
  return 161 / block_size;
}

double damping_scale(const PoseGraphProblem& problem) {
  const int size = residual_size(problem.kind);
  double largest = 0;
  for (const PoseGraphInformation& w : problem.information)
    largest = std::max(largest, w.diagonal().head(size).maxCoeff());
  const double edges_per_vertex =
      2.0 * static_cast<double>(problem.edges.size()) /
      static_cast<double>(std::max<std::size_t>(1, problem.poses.size()));
  return std::max(largest * edges_per_vertex, 1e-12);
}

}  // namespace

/// What the iteration asks for, from an executor that gives the cost with the step.
class Solver::Steps {
 public:
  Steps(StepExecutor& executor, bool unknowns, double initial_cost, PoseGraphResult& result)
      : executor_(executor), unknowns_(unknowns), initial_cost_(initial_cost), result_(result) {}

  bool has_unknowns() const { return unknowns_; }
  double initial_cost() const { return initial_cost_; }
  bool factor(double lambda, double& expected) {
    const Stopwatch watch;
    last_ = executor_.factor_step(lambda);
    result_.times.factor_ms += watch.elapsed_ms();
    expected = 0.5 * last_.squared_norm;
    return last_.positive_definite != 0;
  }
  double refine() {
    const Stopwatch watch;
    last_ = executor_.old_factor_step();
    result_.times.solve_ms += watch.elapsed_ms();
    return 0.5 * last_.squared_norm;
  }
  double candidate_cost() const { return last_.cost; }
  void accept() { executor_.accept(); }

 private:
  StepExecutor& executor_;
  bool unknowns_;
  double initial_cost_;
  PoseGraphResult& result_;
  StepResult last_{};
};

/// One walk over the problem that checks it, compares it with the structure kept, and hands the
/// numbers over: memory is read once.
Solver::Walk Solver::load(const PoseGraphProblem& problem, const PoseGraphOptions& options) {
  const std::size_t n = problem.poses.size(), m = problem.edges.size();
  if (!problem.fixed.empty() && problem.fixed.size() != n) return {false, false};
  if (find_information_error(problem)) return {false, false};
  zero_matrix_.resize(problem.information.size());
  numbers_ = executor_->stage(n, m, problem.information.size());
  for (std::size_t k = 0; k < zero_matrix_.size(); ++k) {
    zero_matrix_[k] = is_zero_information(problem, problem.information[k]);
    for (int r = 0; r < 7; ++r)
      for (int c = 0; c <= r; ++c)
        numbers_.matrices[28 * k + packed(r, c)] = problem.information[k](r, c);
  }
  damping_scale_ = damping_scale(problem);
  // The origin moves to the middle of the graph: derivatives contain positions, and large
  // coordinates would cost digits.
  origin_.setZero();
  for (const Sim3& pose : problem.poses) origin_ += pose.translation;
  if (n > 0) origin_ /= static_cast<double>(n);
  const bool comparable =
      num_poses_ == static_cast<int>(n) && model_ == model_of(problem) && ends_.size() == 2 * m;
  const std::size_t pose_chunks = (n + kWalk - 1) / kWalk, edge_chunks = (m + kWalk - 1) / kWalk;
  walks_.assign(pose_chunks + edge_chunks, Walk());
  passes_.for_chunks(walks_.size(), [&](std::size_t k) {
    const std::size_t begin = (k < pose_chunks ? k : k - pose_chunks) * kWalk;
    walks_[k] = k < pose_chunks ? load_poses(problem, comparable, begin, std::min(n, begin + kWalk))
                                : load_edges(problem, comparable, options.robust_on_all_edges,
                                             begin, std::min(m, begin + kWalk));
  });
  Walk all{true, comparable};
  for (const Walk& walk : walks_) {
    all.valid = all.valid && walk.valid;
    all.same_structure = all.same_structure && walk.same_structure;
  }
  return all;
}

Solver::Walk Solver::load_poses(const PoseGraphProblem& problem, bool comparable, std::size_t begin,
                                std::size_t end) const {
  Walk walk;
  for (std::size_t i = begin; i < end; ++i) {
    const Sim3& pose = problem.poses[i];
    walk.valid = walk.valid && is_valid_pose(pose);
    if (comparable)
      walk.same_structure = walk.same_structure && fixed_at(problem, i) == (fixed_[i] != 0);
    double* p = numbers_.poses + 8 * i;
    put(pose, p);
    for (int k = 0; k < 3; ++k) p[4 + k] -= origin_[k];
  }
  return walk;
}

Solver::Walk Solver::load_edges(const PoseGraphProblem& problem, bool comparable, bool all_robust,
                                std::size_t begin, std::size_t end) const {
  Walk walk;
  const int n = static_cast<int>(problem.poses.size());
  const int matrices = static_cast<int>(problem.information.size());
  for (std::size_t k = begin; k < end; ++k) {
    const PoseGraphEdge& e = problem.edges[k];
    if (e.from < 0 || e.from >= n || e.to < 0 || e.to >= n || e.from == e.to || e.information < 0 ||
        e.information >= matrices || !is_valid_pose(e.T_from_to))
      return {false, false};
    if (comparable)
      walk.same_structure = walk.same_structure && ends_[2 * k] == e.from &&
                            ends_[2 * k + 1] == e.to &&
                            zero_matrix_[e.information] == zero_edge_[k];
    put(e.T_from_to, numbers_.measurement + 8 * k);
    numbers_.information[k] = 2 * e.information + (all_robust || e.switchable ? 1 : 0);
  }
  return walk;
}

void Solver::prepare(const PoseGraphProblem& problem, PoseGraphResult& result) {
  if (!result.plan_reused) {
    Stopwatch watch;
    std::vector<int> old_node;  // [poses]
    if (num_poses_ > 0 && model_ == model_of(problem)) {
      old_node.assign(static_cast<std::size_t>(num_poses_), -1);
      for (int k = 0; k < dissection_.size(); ++k)
        for (int i = dissection_.begin[k]; i < dissection_.begin[k + 1]; ++i)
          old_node[free_pose_[dissection_.vertices[i]]] = k;
    }
    num_poses_ = -1;  // nothing is kept if something fails below
    kind_ = problem.kind;
    model_ = model_of(problem);
    const int n = static_cast<int>(problem.poses.size());
    fixed_.resize(problem.poses.size());
    for (int i = 0; i < n; ++i) fixed_[i] = fixed_at(problem, i);
    ends_.resize(2 * problem.edges.size());
    zero_edge_.resize(problem.edges.size());
    for (std::size_t k = 0; k < problem.edges.size(); ++k) {
      ends_[2 * k] = problem.edges[k].from;
      ends_[2 * k + 1] = problem.edges[k].to;
      zero_edge_[k] = zero_matrix_[problem.edges[k].information];
    }
    find_held_vertices(problem, held_);
    free_index_.assign(n, -1);
    free_pose_.clear();
    for (int i = 0; i < n; ++i) {
      if (held_.held[i]) continue;
      free_index_[i] = static_cast<int>(free_pose_.size());
      free_pose_.push_back(i);
    }
    std::vector<int> free_ends;
    free_ends.reserve(ends_.size());
    for (std::size_t k = 0; k < ends_.size(); k += 2) {
      const int a = free_index_[ends_[k]], b = free_index_[ends_[k + 1]];
      if (a < 0 || b < 0) continue;
      free_ends.push_back(a);
      free_ends.push_back(b);
    }
    block::Graph graph;
    block::build_graph(static_cast<int>(free_pose_.size()), free_ends, graph);
    result.times.symbolic_ms += watch.elapsed_ms();
    analyse(graph, old_node, result);
    watch.restart();
    executor_->set_schedule(schedule_, model_);
    num_poses_ = n;
    result.times.symbolic_ms += watch.elapsed_ms();
  }
  result.components = held_.components;
  result.anchored = held_.anchored;
}

void Solver::analyse(const block::Graph& graph, const std::vector<int>& old_node_of_pose,
                     PoseGraphResult& result) {
  const int block_size = model_tangent(model_), n = graph.size();
  const auto build = [&](const Dissection& dissection) {
    const Stopwatch watch;
    build_schedule({block_size, static_cast<int>(fixed_.size()), &ends_, &free_index_, &free_pose_},
                   graph, dissection, executor_->max_shared_doubles(), schedule_);
    result.times.symbolic_ms += watch.elapsed_ms();
  };
  Stopwatch watch;
  int known = 0;
  std::vector<int> node_of(free_pose_.size(), -1);
  for (int v = 0; v < n; ++v) {
    const std::size_t pose = static_cast<std::size_t>(free_pose_[v]);
    if (pose < old_node_of_pose.size()) node_of[v] = old_node_of_pose[pose];
    known += node_of[v] >= 0;
  }
  Dissection extended;
  result.plan_extended = false;
  const bool extend = known > n / 2 && extend_dissection(graph, node_of, dissection_.parent,
                                                         leaf_size(block_size), extended);
  result.times.ordering_ms += watch.elapsed_ms();
  if (extend) {
    build(extended);
    // Extending again and again wears the order out.
    result.plan_extended =
        schedule_.multiply_adds <= 1.3 * work_per_vertex_ * n && schedule_.levels <= levels_ + 4;
  }
  if (result.plan_extended) {
    dissection_ = std::move(extended);
    return;
  }
  watch.restart();
  dissection_ = dissect(graph, leaf_size(block_size), max_front(block_size));
  result.times.ordering_ms += watch.elapsed_ms();
  build(dissection_);
  work_per_vertex_ = schedule_.multiply_adds / std::max(1, n);
  levels_ = schedule_.levels;
}

void Solver::store(PoseGraphProblem& problem) {
  const double* poses = executor_->poses();
  const std::size_t n = problem.poses.size();
  passes_.for_chunks((n + kWalk - 1) / kWalk, [&](std::size_t chunk) {
    const std::size_t end = std::min(n, (chunk + 1) * kWalk);
    for (std::size_t i = chunk * kWalk; i < end; ++i) {
      if (free_index_[i] < 0) continue;
      const double* p = poses + 8 * i;
      Sim3& pose = problem.poses[i];
      pose.rotation = Eigen::Quaterniond(p[3], p[0], p[1], p[2]);
      pose.translation = Vector3d(p[4], p[5], p[6]) + origin_;
      pose.scale = p[7];
    }
  });
}

int Solver::reject_outliers(const PoseGraphProblem& problem, double gate, PoseGraphResult& result) {
  std::vector<double> squared(problem.edges.size());
  executor_->squared(squared);
  for (std::size_t s = 0; s < squared.size(); ++s) {
    const int edge = schedule_.edge_of_slot[s];
    if (!problem.edges[edge].switchable || squared[s] <= gate) continue;
    result.rejected.push_back(edge);
    numbers_.information[edge] = -1;
  }
  std::sort(result.rejected.begin(), result.rejected.end());
  return static_cast<int>(result.rejected.size());
}

void Solver::solve(PoseGraphProblem& problem, const PoseGraphOptions& options,
                   PoseGraphResult& result) {
  const auto lock = executor_->lock();
  const auto [launches, waits] = executor_->launches_and_waits();
  passes_.set_threads(options.threads);
  Stopwatch watch;
  const Walk walk = load(problem, options);
  if (!walk.valid) {
    result.status = PoseGraphStatus::kInvalidProblem;
    result.reason = find_pose_graph_error(problem).value_or("the problem is not valid");
    return;
  }
  result.plan_reused = walk.same_structure;
  result.times.update_ms += watch.elapsed_ms();
  prepare(problem, result);
  watch.restart();
  double cost = executor_->start(static_cast<int>(options.robust_kernel), options.robust_width);
  result.times.update_ms += watch.elapsed_ms();
  const bool unknowns = !free_pose_.empty();
  IterationRule rule;
  rule.damping_scale = damping_scale_;
  rule.floor = 1e-24 * damping_scale_ * static_cast<double>(problem.edges.size());
  const auto iterate = [&] {
    Steps steps(*executor_, unknowns, cost, result);
    PoseGraphIteration<Steps>(steps, rule, options, result).run();
  };
  iterate();
  if (std::isfinite(options.rejection_gate) &&
      reject_outliers(problem, options.rejection_gate, result) > 0) {
    cost = executor_->restart(0);
    iterate();
  }
  result.initial_cost = result.cost_history.front();
  watch.restart();
  store(problem);
  result.times.update_ms += watch.elapsed_ms();
  const auto [launches_now, waits_now] = executor_->launches_and_waits();
  result.device = {static_cast<int>(schedule_.fronts.size()),
                   schedule_.levels,
                   schedule_.tiled_fronts,
                   schedule_.critical_columns,
                   schedule_.multiply_adds,
                   8.0 * static_cast<double>(schedule_.panel_doubles + schedule_.schur_doubles),
                   static_cast<int>(launches_now - launches),
                   static_cast<int>(waits_now - waits)};
}

bool solve_on_device(std::unique_ptr<Solver>& kept, PoseGraphProblem& problem,
                     const PoseGraphOptions& options, PoseGraphResult& result) {
  std::unique_ptr<StepExecutor> executor;
  if (!kept) {
    try {
      executor = make_cuda_executor();
    } catch (const std::runtime_error& e) {
      logger("pose graph").warn("the device is not used: {}", e.what());
    }
    if (!executor) return false;
    kept = std::make_unique<Solver>(std::move(executor));
  }
  try {
    kept->solve(problem, options, result);
    result.on_device = true;
    return true;
  } catch (const std::runtime_error& e) {
    kept->report_failure(e.what());
    kept.reset();
  }
  return false;
}

}  // namespace fastloop::optimization::device
