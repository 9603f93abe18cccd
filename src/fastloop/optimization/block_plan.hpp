#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "fastloop/optimization/block_kernels.hpp"
#include "fastloop/optimization/block_ordering.hpp"

namespace fastloop::optimization::block {

class Passes;

/// Supernode of the elimination: `pivots` block columns that are eliminated together, and the rows
/// below them.
struct Front {
  int first = 0, pivots = 0,
      below = 0;  ///< block columns [first, first + pivots) in elimination order
  int parent = -1;
  int task = 0;
  std::size_t rows = 0;  ///< into SymbolicPlan::rows and position_in_parent, `below` entries
  std::size_t runs = 0;  ///< into SymbolicPlan::runs
  int num_runs = 0;
  std::size_t children = 0;  ///< into SymbolicPlan::children
  int num_children = 0;
  int panel_stride = 0, schur_stride = 0, schur_first_row = 0;
  std::size_t panel_offset = 0, rhs_offset = 0;  ///< doubles
  /// Doubles into the memory that all tasks share if the parent belongs to another task, otherwise
  /// into the scratch of the thread at work.
  std::size_t schur_offset = 0;
  bool schur_shared = false;
};

/// A set of fronts processed by one thread in this order. Tasks form a tree: a task starts when all
/// tasks that feed it have ended.
struct Task {
  std::size_t begin = 0, end = 0;  ///< into SymbolicPlan::task_fronts
  int parent = -1;
  int num_feeding = 0;
  double path = 0;   ///< work of this task and of all on the way to its root
  double below = 0;  ///< work of the costliest way from a leaf up to this task, itself included
};

/// Elimination structure of a block-sparse symmetric matrix.
struct SymbolicPlan {
  std::vector<int> order;     ///< [n] vertex eliminated k-th
  std::vector<int> position;  ///< [n] inverse of order
  std::vector<Front> fronts;  ///< children before parents
  std::vector<int> front_of;  ///< [n] by elimination index
  std::vector<int> rows;
  std::vector<std::int32_t> position_in_parent;
  std::vector<Run> runs;
  std::vector<int> children;
  std::vector<Task> tasks;  ///< feeding tasks before the task they feed
  std::vector<int> task_fronts;
  std::size_t panel_size = 0, rhs_size = 0;  ///< doubles
  std::size_t schur_size = 0;                ///< doubles, update matrices handed between tasks
  std::size_t scratch_size = 0;              ///< doubles, all others of one task
  int max_front_blocks = 0;
  double work = 0;  ///< multiplications and additions of one factorisation, estimated
};

/// The kernels this machine runs, the widest last.
std::vector<const KernelSet*> usable_kernels();

/// Elimination of `graph` in the given order (which becomes a postorder of the elimination tree),
/// for blocks of `block_size` unknowns. The result does not depend on the threads of `passes`.
void build_symbolic_plan(const Graph& graph, std::vector<int> order, int block_size, Passes& passes,
                         SymbolicPlan& plan);

}  // namespace fastloop::optimization::block
