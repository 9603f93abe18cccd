#include "fastloop/optimization/pose_graph_check.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <numeric>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {
namespace {

/// Message of what is wrong with an information matrix, or null.
const char* information_fault(const PoseGraphInformation& full, int size) {
  const auto m = full.topLeftCorner(size, size);
  if (!m.allFinite()) return "is not finite";
  const double largest = m.cwiseAbs().maxCoeff();
  if ((m - m.transpose()).cwiseAbs().maxCoeff() > 1e-9 * largest) return "is not symmetric";
  if (m.isDiagonal(0.0)) return (m.diagonal().array() < 0).any() ? "is indefinite" : nullptr;
  // A successful Cholesky factorisation settles the common case; otherwise eigenvalues tell
  // semi-definite from indefinite.
  Matrix7d padded = Matrix7d::Identity();
  padded.topLeftCorner(size, size) = m;
  if (Eigen::LLT<Matrix7d>(padded).info() == Eigen::Success) return nullptr;
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(m, Eigen::EigenvaluesOnly);
  return eigen.eigenvalues().minCoeff() < -1e-9 * largest ? "is indefinite" : nullptr;
}

int find_root(std::vector<int>& parent, int v) {
  while (parent[v] != v) v = parent[v] = parent[parent[v]];
  return v;
}

}  // namespace

void PoseGraphOptions::validate() const {
  const auto require = [](bool ok, const char* what) {
    if (!ok) throw InvalidArgument(std::string("PoseGraphOptions: ") + what);
  };
  require(threads >= 1 && threads <= 1024, "threads must be in [1, 1024]");
  require(max_iterations >= 0, "max_iterations must not be negative");
  require(relative_tolerance >= 0 && relative_tolerance < 1,
          "relative_tolerance must be in [0, 1)");
  require(robust_width > 0 && std::isfinite(robust_width), "robust_width must be positive");
  require(rejection_gate > 0, "rejection_gate must be positive");
  require(initial_trust_region_radius > 0, "initial_trust_region_radius must be positive");
}

bool is_valid_pose(const Sim3& pose) {
  return pose.is_finite() && pose.scale > 0 && std::abs(pose.rotation.squaredNorm() - 1) < 1e-6;
}

std::optional<std::string> find_information_error(const PoseGraphProblem& problem) {
  const int size = residual_size(problem.kind);
  for (std::size_t k = 0; k < problem.information.size(); ++k)
    if (const char* fault = information_fault(problem.information[k], size))
      return "information matrix " + std::to_string(k) + " " + fault;
  return std::nullopt;
}

std::optional<std::string> find_pose_graph_error(const PoseGraphProblem& problem) {
  const int n = static_cast<int>(problem.poses.size());
  if (!problem.fixed.empty() && problem.fixed.size() != problem.poses.size())
    return "fixed has " + std::to_string(problem.fixed.size()) + " entries for " +
           std::to_string(n) + " poses";
  for (int i = 0; i < n; ++i)
    if (!is_valid_pose(problem.poses[i]))
      return "pose " + std::to_string(i) + " is not a finite pose";
  if (std::optional<std::string> error = find_information_error(problem)) return error;
  for (std::size_t k = 0; k < problem.edges.size(); ++k) {
    const PoseGraphEdge& e = problem.edges[k];
    const auto fault = [k](const std::string& what) {
      return "edge " + std::to_string(k) + " " + what;
    };
    if (e.from < 0 || e.from >= n || e.to < 0 || e.to >= n)
      return fault("joins " + std::to_string(e.from) + " and " + std::to_string(e.to) +
                   " but there are " + std::to_string(n) + " vertices");
    if (e.from == e.to) return fault("joins vertex " + std::to_string(e.from) + " to itself");
    if (e.information < 0 || e.information >= static_cast<int>(problem.information.size()))
      return fault("refers to a missing information matrix");
    if (!is_valid_pose(e.T_from_to)) return fault("has a measurement that is not a finite pose");
  }
  return std::nullopt;
}

bool is_zero_information(const PoseGraphProblem& problem, const PoseGraphInformation& information) {
  const int size = residual_size(problem.kind);
  return (information.topLeftCorner(size, size).array() == 0).all();
}

void find_held_vertices(const PoseGraphProblem& problem, HeldVertices& result) {
  const int n = static_cast<int>(problem.poses.size());
  std::vector<std::uint8_t> zero(problem.information.size());
  for (std::size_t k = 0; k < zero.size(); ++k)
    zero[k] = is_zero_information(problem, problem.information[k]);
  std::vector<int> parent(n);
  std::iota(parent.begin(), parent.end(), 0);
  std::vector<std::uint8_t> touched(n, 0), has_fixed(n, 0);
  for (const PoseGraphEdge& e : problem.edges) {
    if (zero[e.information]) continue;
    touched[e.from] = touched[e.to] = 1;
    const int a = find_root(parent, e.from), b = find_root(parent, e.to);
    parent[std::max(a, b)] = std::min(a, b);  // the root is the first vertex of its component
  }
  result.held.assign(n, 0);
  result.components = result.anchored = 0;
  for (int i = 0; i < n; ++i) {
    const bool fixed = !problem.fixed.empty() && problem.fixed[i];
    if (fixed) has_fixed[find_root(parent, i)] = 1;
    result.held[i] = fixed || !touched[i];
  }
  for (int i = 0; i < n; ++i) {
    if (!touched[i] || find_root(parent, i) != i) continue;
    ++result.components;
    if (has_fixed[i]) continue;
    result.held[i] = 1;
    ++result.anchored;
  }
}

}  // namespace fastloop::optimization
