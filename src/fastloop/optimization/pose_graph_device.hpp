#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "fastloop/optimization/block_passes.hpp"
#include "fastloop/optimization/pose_graph_check.hpp"
#include "fastloop/optimization/pose_graph_steps.hpp"

/// The pose-graph solver for devices: host side. No CUDA header is needed here.
namespace fastloop::optimization::device {

/// What solve_pose_graph calls for PoseGraphSolverKind::kCuda. Keeps the structure for the next
/// call, as PoseGraphPlan does.
class Solver {
 public:
  explicit Solver(std::unique_ptr<StepExecutor> executor) : executor_(std::move(executor)) {}
  void solve(PoseGraphProblem& problem, const PoseGraphOptions& options, PoseGraphResult& result);
  const Schedule& schedule() const { return schedule_; }
  void report_failure(const std::string& what) { executor_->report_failure(what); }

 private:
  class Steps;
  /// What one walk over the problem finds.
  struct Walk {
    bool valid = true, same_structure = true;
  };
  Walk load(const PoseGraphProblem& problem, const PoseGraphOptions& options);
  Walk load_poses(const PoseGraphProblem& problem, bool comparable, std::size_t begin,
                  std::size_t end) const;
  Walk load_edges(const PoseGraphProblem& problem, bool comparable, bool all_robust,
                  std::size_t begin, std::size_t end) const;
  void prepare(const PoseGraphProblem& problem, PoseGraphResult& result);
  /// The elimination of the present graph, from the one before if that still serves.
  void analyse(const block::Graph& graph, const std::vector<int>& old_node_of_pose,
               PoseGraphResult& result);
  void store(PoseGraphProblem& problem);
  int reject_outliers(const PoseGraphProblem& problem, double gate, PoseGraphResult& result);

  std::unique_ptr<StepExecutor> executor_;
  // Structure, valid for the remembered edge ends.
  PoseGraphKind kind_ = PoseGraphKind::kSe3;
  block::EdgeModel model_ = block::EdgeModel::kSe3;
  int num_poses_ = -1;
  std::vector<std::uint8_t> fixed_, zero_edge_;
  std::vector<int> ends_, free_index_, free_pose_;
  HeldVertices held_;
  Dissection dissection_;
  double work_per_vertex_ = 0;  ///< when the graph was last dissected as a whole
  int levels_ = 0;
  Schedule schedule_;
  // Numbers.
  block::Passes passes_;
  Numbers numbers_;
  std::vector<Walk> walks_;
  std::vector<std::uint8_t> zero_matrix_;
  Vector3d origin_ = Vector3d::Zero();
  double damping_scale_ = 1;
};

/// Solves on the CUDA device with the solver in `kept`, which is made where it is missing. False
/// without a device or when it fails: then the problem is untouched and the result of no use.
/// Checks the problem as solve_pose_graph does.
bool solve_on_device(std::unique_ptr<Solver>& kept, PoseGraphProblem& problem,
                     const PoseGraphOptions& options, PoseGraphResult& result);

}  // namespace fastloop::optimization::device
