#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "fastloop/geometry/sim3.hpp"

/// Pose-graph optimisation on flat problems. docs/pose-graph.md derives the residuals, their
/// derivatives and the elimination; nothing here knows a map.
namespace fastloop::optimization {

/// What a vertex may do and how an edge is measured. With X_i the pose `T_world_i`, Z the
/// measurement `T_from_to` and E = Z^-1 X_from^-1 X_to, residuals are
///   kYaw    [Log(R_from^T R_to R_Z^T); R_from^T (t_to - t_from) - t_Z]   6 numbers, 4 unknowns a
///   vertex kSe3    [vector part of the quaternion of E (w >= 0); translation of E]  6 numbers, 6
///   unknowns (as g2o) kSim3   log(E) = [rotation, translation, log scale]                  7
///   numbers, 7 unknowns (6 at fixed scale)
enum class PoseGraphKind : int { kYaw, kSe3, kSim3 };

/// Robust kernels on the squared, information-weighted residual; `width` is in standard deviations.
enum class RobustKernel : int { kNone, kHuber, kCauchy, kDynamicCovarianceScaling };

enum class PoseGraphSolverKind : int {
  kBlock,      ///< ours: analytic Jacobians, block multifrontal Cholesky
  kCeres,      ///< the same residuals and Jacobians in Ceres with SPARSE_NORMAL_CHOLESKY
  kReference,  ///< the published way: central differences, Levenberg-Marquardt, scalar sparse LDLT
  kCuda,       ///< as kBlock, on the CUDA device; where there is none, or it fails, kBlock
};

struct PoseGraphEdge {
  int from = 0, to = 0;
  Sim3 T_from_to;
  int information = 0;  ///< index into PoseGraphProblem::information
  bool switchable =
      false;  ///< a loop: the robust kernel and the rejection of outliers apply to this edge
};

/// Information matrix in the order of the residual: rotation, translation, log scale. The last row
/// and column are ignored where the residual has six numbers.
using PoseGraphInformation = Matrix7d;

struct PoseGraphProblem {
  PoseGraphKind kind = PoseGraphKind::kSe3;
  bool fixed_scale = false;  ///< kSim3 only: keeps the scale of every vertex
  std::vector<Sim3> poses;   ///< [n] T_world_i, start values and result; scale 1 unless kSim3
  std::vector<std::uint8_t> fixed;  ///< [n] or empty (= none)
  std::vector<PoseGraphEdge> edges;
  std::vector<PoseGraphInformation> information{
      PoseGraphInformation::Identity()};  ///< shared by edges
};

/// Information of the published 4-DoF graph. The public code writes diag(1e3, 1e3, 1, 1, 1, 1),
/// which leaves the third rotation axis at 1; the residual is a rotation vector in the body frame,
/// so an error in yaw falls on whichever axis points along gravity. All three axes must weigh the
/// same for yaw to have one weight.
inline PoseGraphInformation published_yaw_information() {
  PoseGraphInformation w = PoseGraphInformation::Identity();
  w.topLeftCorner<3, 3>() *= 1e3;
  return w;
}

enum class PoseGraphStatus : int {
  kConverged,
  kMaxIterations,   ///< ended by max_iterations; the cost is the lowest seen
  kStalled,         ///< no step lowers the cost any more although the stopping rule is not met
  kInvalidProblem,  ///< refused, see reason; poses are untouched
};

struct PoseGraphOptions {
  PoseGraphSolverKind solver = PoseGraphSolverKind::kBlock;
  int threads = 1;  ///< block: oneTBB arena of this size; the result does not depend on it
  int max_iterations = 50;
  /// Stop when the decrease still to be expected is below this fraction of the cost.
  double relative_tolerance = 1e-7;
  RobustKernel robust_kernel = RobustKernel::kNone;
  double robust_width = 2.0;
  bool robust_on_all_edges = false;  ///< otherwise only on switchable ones
  /// After convergence switchable edges with a squared residual above this are taken out and the
  /// rest is solved again, without the robust kernel. Infinity: no rejection.
  double rejection_gate = std::numeric_limits<double>::infinity();
  /// Block only: linearise once more, on the clock, so that linearize_ms and factor_ms can be told
  /// apart. Otherwise fronts linearise their edges as they go, which is faster, and factor_ms
  /// contains both.
  bool split_times = false;
  /// Ceres and reference only: end as soon as the cost is at most this. For measurements to equal
  /// accuracy.
  double target_cost = -std::numeric_limits<double>::infinity();
  /// Ceres only.
  double initial_trust_region_radius = 1e16;
  /// Throws InvalidArgument naming the field.
  void validate() const;
};

struct PoseGraphTimes {
  double ordering_ms = 0, symbolic_ms = 0, linearize_ms = 0, factor_ms = 0, solve_ms = 0,
         update_ms = 0, total_ms = 0;
};

/// How the device went about it: what an estimate of the time is made of.
struct PoseGraphDeviceCounts {
  int fronts = 0, levels = 0, tiled_fronts = 0;
  double critical_columns = 0;  ///< unknowns that must be eliminated one after the other
  double multiply_adds = 0;     ///< of one factorisation
  double factor_bytes = 0;      ///< of L and of the matrices handed from front to front
  int launches = 0, synchronizations = 0;  ///< of this call
};

struct PoseGraphResult {
  PoseGraphStatus status = PoseGraphStatus::kConverged;
  std::string reason;  ///< one sentence; empty when converged
  double initial_cost = 0,
         final_cost = 0;             ///< half the sum of the (robust) squared weighted residuals
  int iterations = 0;                ///< factorisations that led to an accepted step
  int factorizations = 0;            ///< all factorisations
  std::vector<double> cost_history;  ///< [1 + accepted steps], starts with initial_cost
  int components = 0;                ///< connected components of the graph
  int anchored = 0;                  ///< vertices held because their component had no fixed vertex
  std::vector<int> rejected;         ///< indices of rejected edges, ascending
  bool plan_reused = false, plan_extended = false;
  bool on_device = false;  ///< computed there; false as well where kCuda fell back to kBlock
  PoseGraphDeviceCounts device;
  PoseGraphTimes times;
  bool usable() const { return status != PoseGraphStatus::kInvalidProblem; }
};

/// Ordering, symbolic structure and work memory of the block solver, kept between calls. A call
/// with the same vertices and edge ends reuses everything and allocates nothing. Where vertices
/// were added at the end or edges changed, the old elimination order is extended if it still
/// serves; otherwise the graph is ordered afresh. A plan serves one call at a time.
class PoseGraphPlan {
 public:
  PoseGraphPlan();
  ~PoseGraphPlan();
  PoseGraphPlan(PoseGraphPlan&&) noexcept;
  PoseGraphPlan& operator=(PoseGraphPlan&&) noexcept;

  class Impl;
  Impl& impl() { return *impl_; }

 private:
  std::unique_ptr<Impl> impl_;
};

/// Optimises problem.poses in place. The cost never ends above the cost at the start. A component
/// without a fixed vertex has its first vertex held; vertices without edges stay where they are.
/// Bad input (an edge to a missing vertex, numbers that are not finite, information that is not
/// symmetric and positive semi-definite) gives kInvalidProblem with the reason and leaves the poses
/// alone.
///
/// Threads  One call per plan at a time; different plans in parallel are fine.
/// @param plan    null: a temporary one
/// @param result  overwritten; its memory is reused
/// @throws InvalidArgument on options outside their range
void solve_pose_graph(PoseGraphProblem& problem, const PoseGraphOptions& options,
                      PoseGraphPlan* plan, PoseGraphResult& result);
PoseGraphResult solve_pose_graph(PoseGraphProblem& problem, const PoseGraphOptions& options = {},
                                 PoseGraphPlan* plan = nullptr);

/// Cost of the problem as it stands, without robust kernel: half the sum of squared weighted
/// residuals.
double pose_graph_cost(const PoseGraphProblem& problem);

/// Reason why a problem cannot be solved, or nothing.
std::optional<std::string> find_pose_graph_error(const PoseGraphProblem& problem);

std::string_view to_string(PoseGraphStatus status);
std::string_view to_string(PoseGraphSolverKind solver);

}  // namespace fastloop::optimization
