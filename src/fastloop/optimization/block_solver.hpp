#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "fastloop/optimization/block_passes.hpp"
#include "fastloop/optimization/pose_graph_check.hpp"
#include "fastloop/optimization/pose_graph_device.hpp"

namespace fastloop::optimization {

/// The block solver's state: structure that is kept between calls and work memory. Defined here so
/// that the plan, the loading of a problem and the iteration can live in files of their own.
class PoseGraphPlan::Impl {
 public:
  Impl();
  ~Impl();

  void solve(PoseGraphProblem& problem, const PoseGraphOptions& options, PoseGraphResult& result);
  /// The same on the CUDA device; false where that cannot be, with the problem as it was.
  bool solve_on_device(PoseGraphProblem& problem, const PoseGraphOptions& options,
                       PoseGraphResult& result) {
    return device::solve_on_device(device_, problem, options, result);
  }
  /// Other kernels than the widest this machine runs.
  void use_kernels(const block::KernelSet& set) { kernel_set_ = &set; }

 private:
  // block_structure.cpp: from edge ends to fronts, tasks and memory
  bool same_structure(const PoseGraphProblem& problem) const;
  bool can_extend(const PoseGraphProblem& problem) const;
  void prepare(const PoseGraphProblem& problem, PoseGraphResult& result);
  std::vector<int> extended_order(const std::vector<int>& old_free_pose,
                                  const std::vector<int>& old_order) const;
  void remember_structure(const PoseGraphProblem& problem);
  void assign_slots(const PoseGraphProblem& problem);
  int position_in(const block::Front& front, int index) const;
  void build_views();
  void resize_scratch();
  void build_view(std::size_t front);

  // block_load.cpp: from the problem's numbers to batches, and back
  void load(const PoseGraphProblem& problem, const PoseGraphOptions& options);
  void load_edge(const PoseGraphProblem& problem, std::size_t slot, bool robust);
  void choose_information_layout(const PoseGraphProblem& problem, bool share);
  void store_poses(PoseGraphProblem& problem);
  int reject_outliers(const PoseGraphProblem& problem, double gate, PoseGraphResult& result);

  // block_solver.cpp: the iteration
  class Steps;
  void iterate(const PoseGraphOptions& options, PoseGraphResult& result);
  double evaluate_cost(const double* poses, double* squared);
  bool factor(double lambda);
  /// Time of linearising all edges once more, for the split of the times.
  double measure_linearization();
  void forward();
  /// Solves for the step; returns the squared norm of L^-1 b.
  double backward();
  double* thread_scratch() { return scratch_[static_cast<std::size_t>(passes_.slot())].data(); }
  /// candidate = poses moved by the step
  void move_poses();
  void build_damping();
  double damping_scale(const PoseGraphProblem& problem) const;

  // Structure, valid for the remembered edge ends.
  PoseGraphKind kind_ = PoseGraphKind::kSe3;
  block::EdgeModel model_ = block::EdgeModel::kSe3;
  int block_size_ = 0;
  int num_poses_ = -1;
  std::vector<std::uint8_t> fixed_;      // as given
  std::vector<std::uint8_t> zero_edge_;  // [edges] information is zero
  std::vector<int> ends_;                // [edges][2]
  HeldVertices held_;
  std::vector<int> free_index_, free_pose_;  // pose -> free vertex or -1, and back
  block::Graph graph_;
  block::SymbolicPlan symbolic_;
  double work_per_vertex_at_ordering_ = 0;
  std::vector<std::int64_t> edge_of_slot_;  // -1: padding
  std::vector<std::int32_t> from_, to_, edge_position_;
  std::vector<std::size_t> front_edges_begin_, front_edges_end_;
  std::size_t num_batches_ = 0;

  // Numbers of the present problem.
  std::vector<std::uint8_t> full_information_;  // [batches]
  std::vector<std::uint8_t> full_matrix_;       // [information matrices]
  std::vector<std::uint8_t> own_information_;   // [batches] not shared with other batches
  std::vector<std::size_t> information_offset_,
      shared_offset_;  // [batches], [information matrices]
  block::Buffer measurement_, information_, robust_;
  Vector3d origin_ = Vector3d::Zero();  // subtracted from all translations
  double damping_scale_ = 1;

  // Work memory.
  block::Buffer panel_, schur_, rhs_, step_, poses_, candidate_, damping_, squared_;
  std::vector<block::Buffer> scratch_;  // [threads]
  std::vector<block::FrontView> fronts_;
  std::vector<block::ChildView> children_;
  std::vector<double> front_norm_, chunk_cost_;
  std::vector<std::uint8_t> task_ok_;
  block::PassContext context_;
  const block::KernelSet* kernel_set_;
  block::ModelKernels kernels_;
  block::Passes passes_;
  std::unique_ptr<device::Solver> device_;  // from the first call that asks for it
};

}  // namespace fastloop::optimization
