#include <Eigen/SparseCholesky>
#include <algorithm>
#include <array>
#include <cmath>

#include "fastloop/core/time.hpp"
#include "fastloop/optimization/pose_graph_baselines.hpp"
#include "fastloop/optimization/pose_graph_check.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {
namespace {

/// Vertex update of the published code: in the vertex's own frame; for 4-DoF yaw about gravity and
/// a shift.
Sim3 move_locally(PoseGraphKind kind, const Sim3& pose, const Vector7d& d) {
  if (kind != PoseGraphKind::kYaw) return pose * Sim3::exp(d);
  return Sim3(so3::exp(Vector3d(0, 0, d[0])) * pose.rotation, pose.translation + d.segment<3>(1),
              1);
}

/// Scalar normal equations, upper triangle; knows where the columns of every edge's blocks start.
template <int D>
class ScalarSystem {
 public:
  using Block = Eigen::Matrix<double, D, D>;
  using Columns = std::array<int, D>;  ///< index of the first value of each column of a block

  ScalarSystem(const PoseGraphProblem& problem, const std::vector<int>& free_index, int num_free) {
    std::vector<Eigen::Triplet<double>> entries;
    for (int v = 0; v < num_free; ++v)
      for (int c = 0; c < D; ++c)
        for (int r = 0; r <= c; ++r) entries.emplace_back(v * D + r, v * D + c, 0.0);
    for (const PoseGraphEdge& e : problem.edges) {
      const int a = free_index[e.from], b = free_index[e.to];
      if (a < 0 || b < 0) continue;
      for (int c = 0; c < D; ++c)
        for (int r = 0; r < D; ++r)
          entries.emplace_back(std::min(a, b) * D + r, std::max(a, b) * D + c, 0.0);
    }
    matrix.resize(num_free * D, num_free * D);
    matrix.setFromTriplets(entries.begin(), entries.end());
    gradient.setZero(num_free * D);
    for (int v = 0; v < num_free; ++v) diagonal.push_back(find(v, v));
    for (const PoseGraphEdge& e : problem.edges) {
      const int a = free_index[e.from], b = free_index[e.to];
      off_diagonal.push_back(a < 0 || b < 0 ? Columns{} : find(std::min(a, b), std::max(a, b)));
    }
  }

  void set_zero() {
    std::fill_n(matrix.valuePtr(), matrix.nonZeros(), 0.0);
    gradient.setZero();
  }
  void add_diagonal(int vertex, const Block& h) {
    for (int c = 0; c < D; ++c)
      for (int r = 0; r <= c; ++r) matrix.valuePtr()[diagonal[vertex][c] + r] += h(r, c);
  }
  void add_off_diagonal(std::size_t edge, const Block& h) {
    for (int c = 0; c < D; ++c)
      for (int r = 0; r < D; ++r) matrix.valuePtr()[off_diagonal[edge][c] + r] += h(r, c);
  }
  double largest_diagonal() const {
    double largest = 0;
    for (const Columns& columns : diagonal)
      for (int c = 0; c < D; ++c) largest = std::max(largest, matrix.valuePtr()[columns[c] + c]);
    return largest;
  }
  void add_to_diagonal(double lambda) {
    for (const Columns& columns : diagonal)
      for (int c = 0; c < D; ++c) matrix.valuePtr()[columns[c] + c] += lambda;
  }

  Eigen::SparseMatrix<double> matrix;
  Eigen::VectorXd gradient;
  std::vector<Columns> diagonal, off_diagonal;

 private:
  Columns find(int row, int column) const {
    Columns result;
    for (int c = 0; c < D; ++c) {
      const int* base = matrix.innerIndexPtr();
      const int* begin = base + matrix.outerIndexPtr()[column * D + c];
      const int* end = base + matrix.outerIndexPtr()[column * D + c + 1];
      result[c] = static_cast<int>(std::lower_bound(begin, end, row * D) - base);
    }
    return result;
  }
};

/// D unknowns a vertex, R residuals an edge.
template <int D, int R>
class ReferenceSolver {
 public:
  ReferenceSolver(PoseGraphProblem& problem, const PoseGraphOptions& options,
                  PoseGraphResult& result)
      : problem_(problem), options_(options), result_(result) {
    HeldVertices held;
    find_held_vertices(problem, held);
    result.components = held.components;
    result.anchored = held.anchored;
    free_index_.assign(problem.poses.size(), -1);
    for (std::size_t i = 0; i < problem.poses.size(); ++i) {
      if (held.held[i]) continue;
      free_index_[i] = static_cast<int>(free_pose_.size());
      free_pose_.push_back(static_cast<int>(i));
    }
  }

  void run() {
    double cost = cost_at(problem_.poses);
    result_.initial_cost = cost;
    result_.cost_history.push_back(cost);
    if (!free_pose_.empty()) minimize(cost);
    result_.final_cost = cost;
  }

 private:
  using Residual = Eigen::Matrix<double, R, 1>;
  using Jacobian = Eigen::Matrix<double, R, D>;

  Residual residual(const PoseGraphEdge& e, const Sim3& from, const Sim3& to) const {
    return edge_residual(problem_.kind, from, to, e.T_from_to).template head<R>();
  }
  Eigen::Matrix<double, R, R> weight(const PoseGraphEdge& e) const {
    return problem_.information[e.information].template topLeftCorner<R, R>();
  }
  RobustValue robust(const PoseGraphEdge& e, double squared) const {
    const bool applies = e.switchable || options_.robust_on_all_edges;
    return evaluate_robust_kernel(applies ? options_.robust_kernel : RobustKernel::kNone,
                                  options_.robust_width, squared);
  }

  double cost_at(const std::vector<Sim3>& poses) const {
    double sum = 0;
    for (const PoseGraphEdge& e : problem_.edges) {
      const Residual r = residual(e, poses[e.from], poses[e.to]);
      sum += robust(e, r.dot(weight(e) * r)).cost;
    }
    return 0.5 * sum;
  }

  /// Central differences, as g2o does for edges without an analytic derivative.
  Jacobian differences(const PoseGraphEdge& e, bool of_from) const {
    constexpr double kStep = 1e-9;
    Jacobian j;
    Vector7d d = Vector7d::Zero();
    const Sim3 &from = problem_.poses[e.from], &to = problem_.poses[e.to];
    for (int c = 0; c < D; ++c) {
      const auto at = [&](double step) {
        d[c] = step;
        return of_from ? residual(e, move_locally(problem_.kind, from, d), to)
                       : residual(e, from, move_locally(problem_.kind, to, d));
      };
      const Residual plus = at(kStep), minus = at(-kStep);
      d[c] = 0;
      j.col(c) = (plus - minus) / (2 * kStep);
    }
    return j;
  }

  void linearize(ScalarSystem<D>& system) const {
    system.set_zero();
    for (std::size_t k = 0; k < problem_.edges.size(); ++k) {
      const PoseGraphEdge& e = problem_.edges[k];
      const int a = free_index_[e.from], b = free_index_[e.to];
      if (a < 0 && b < 0) continue;
      const Residual r = residual(e, problem_.poses[e.from], problem_.poses[e.to]);
      const Eigen::Matrix<double, R, R> w = weight(e) * robust(e, r.dot(weight(e) * r)).weight;
      const Residual wr = w * r;
      Jacobian from = Jacobian::Zero(), to = Jacobian::Zero();
      if (a >= 0) {
        from = differences(e, true);
        system.add_diagonal(a, from.transpose() * w * from);
        system.gradient.template segment<D>(a * D) += from.transpose() * wr;
      }
      if (b >= 0) {
        to = differences(e, false);
        system.add_diagonal(b, to.transpose() * w * to);
        system.gradient.template segment<D>(b * D) += to.transpose() * wr;
      }
      if (a < 0 || b < 0) continue;
      if (a < b) {
        system.add_off_diagonal(k, from.transpose() * w * to);
      } else {
        system.add_off_diagonal(k, to.transpose() * w * from);
      }
    }
  }

  std::vector<Sim3> moved(const Eigen::VectorXd& step) const {
    std::vector<Sim3> poses = problem_.poses;
    for (std::size_t v = 0; v < free_pose_.size(); ++v) {
      Vector7d d = Vector7d::Zero();
      d.head<D>() = step.segment<D>(static_cast<Eigen::Index>(v) * D);
      poses[free_pose_[v]] = move_locally(problem_.kind, poses[free_pose_[v]], d);
    }
    return poses;
  }

  /// One iteration: up to ten dampings. Returns false when nothing lowers the cost.
  bool iterate(ScalarSystem<D>& system, double& cost) {
    for (int trial = 0; trial < 10; ++trial) {
      Stopwatch watch;
      system.add_to_diagonal(lambda_);
      ldlt_.factorize(system.matrix);
      system.add_to_diagonal(-lambda_);
      result_.times.factor_ms += watch.elapsed_ms();
      ++result_.factorizations;
      double gain = -1;
      if (ldlt_.info() == Eigen::Success) {
        watch.restart();
        const Eigen::VectorXd step = ldlt_.solve(-system.gradient);
        result_.times.solve_ms += watch.elapsed_ms();
        watch.restart();
        std::vector<Sim3> candidate = moved(step);
        const double candidate_cost = cost_at(candidate);
        result_.times.update_ms += watch.elapsed_ms();
        const double expected = 0.5 * step.dot(lambda_ * step - system.gradient) + 1e-300;
        gain = (cost - candidate_cost) / expected;
        if (gain > 0 && std::isfinite(candidate_cost)) {
          lambda_ *= std::max(1.0 / 3, std::min(2.0 / 3, 1 - std::pow(2 * gain - 1, 3)));
          growth_ = 2;
          problem_.poses = std::move(candidate);
          cost = candidate_cost;
          return true;
        }
      }
      lambda_ *= growth_;
      growth_ *= 2;
    }
    return false;
  }

  void minimize(double& cost) {
    Stopwatch watch;
    ScalarSystem<D> system(problem_, free_index_, static_cast<int>(free_pose_.size()));
    ldlt_.analyzePattern(system.matrix);
    result_.times.symbolic_ms += watch.elapsed_ms();
    int idle = 0;
    for (int iteration = 0; iteration < options_.max_iterations; ++iteration) {
      watch.restart();
      linearize(system);
      result_.times.linearize_ms += watch.elapsed_ms();
      if (iteration == 0)
        lambda_ = problem_.kind == PoseGraphKind::kSim3 ? 1e-16 : 1e-5 * system.largest_diagonal();
      const double before = cost;
      if (!iterate(system, cost)) return;
      ++result_.iterations;
      result_.cost_history.push_back(cost);
      idle = (before - cost) * 1e3 < before ? idle + 1 : 0;
      if (idle >= 3 || cost <= options_.target_cost) return;
    }
    result_.status = PoseGraphStatus::kMaxIterations;
    result_.reason = "ended by max_iterations";
  }

  PoseGraphProblem& problem_;
  const PoseGraphOptions& options_;
  PoseGraphResult& result_;
  std::vector<int> free_index_, free_pose_;
  Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>, Eigen::Upper> ldlt_;
  double lambda_ = 0, growth_ = 2;
};

}  // namespace

void solve_with_reference(PoseGraphProblem& problem, const PoseGraphOptions& options,
                          PoseGraphResult& result) {
  if (problem.kind == PoseGraphKind::kYaw) {
    ReferenceSolver<4, 6>(problem, options, result).run();
  } else if (problem.kind == PoseGraphKind::kSe3) {
    ReferenceSolver<6, 6>(problem, options, result).run();
  } else if (problem.fixed_scale) {
    ReferenceSolver<6, 7>(problem, options, result).run();
  } else {
    ReferenceSolver<7, 7>(problem, options, result).run();
  }
}

}  // namespace fastloop::optimization
