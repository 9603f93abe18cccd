#pragma once

#include <cstdint>

#include "fastloop/compute/host_device.hpp"

/// Flat structs that host and device share: the elimination as the device runs it.
namespace fastloop::optimization::device {

/// Scalar rows of a tile of a large front at most; a tile holds whole blocks, and the last one of a
/// front the right-hand side as well.
inline constexpr int kTileRows = 64;
FASTLOOP_HD constexpr int tile_blocks(int block_size) {
  return (kTileRows - 1) / block_size;
}
/// Columns eliminated between two barriers.
inline constexpr int kPanel = 8;
/// Columns that one warp takes through a substitution without a barrier.
inline constexpr int kStrip = 32;

/// A dense matrix of (pivots + below) blocks and one more row, the right-hand side. Its pivots are
/// eliminated and the rest is handed to the parent.
struct Front {
  std::int32_t pivots, below;
  std::int32_t first;  ///< elimination index of the first pivot
  std::int32_t parent;
  std::int32_t children, num_children;  ///< into View::children
  std::int32_t pairs_begin, pairs_end;  ///< into View::pairs, not used where tiled
  std::int32_t rows;                    ///< into View::rows and View::map, `below` entries
  std::int32_t rhs;                     ///< into View::rhs, `below` blocks
  std::int32_t tiled;                   ///< 0: one task, in shared memory
  std::int32_t tasks;                   ///< signals until the parent may read
  std::int32_t tile_flags;              ///< into View::tile_done
  std::int32_t panel_stride, schur_stride;
  std::int64_t panel, schur;  ///< doubles; column-major
};

/// Edges between the same two free vertices: block (row, column) of the front that eliminates the
/// first of them gets minus the sum of their matrices.
struct Pair {
  std::int32_t row, column;  ///< blocks of the front
  std::int32_t begin, end;   ///< slots
};

/// One step of the elimination: a front or a tile of one.
struct Task {
  std::int32_t front;
  std::int32_t row_tile, column_tile;  ///< of tiled fronts
  std::int32_t pairs_begin, pairs_end;
};

/// What one step found.
struct StepResult {
  double squared_norm;  ///< of L^-1 b: twice the expected decrease
  double cost;          ///< at the poses the step leads to, half the sum
  std::int32_t positive_definite;
  std::int32_t sequence;  ///< counts the results
};

/// Everything the passes read and write. All pointers into one memory, of the device or the host.
struct View {
  // Structure.
  int num_fronts, num_tasks, num_vertices, num_slots, num_poses;
  const Front* fronts;
  const Task* tasks;             ///< children before parents
  const std::int32_t* ascent;    ///< [fronts] children before parents
  const std::int32_t* descent;   ///< [fronts] parents before children
  const std::int32_t* children;  ///< fronts
  const std::int32_t* rows;      ///< elimination indices of the blocks below
  const std::int32_t* map;       ///< the same blocks in the parent
  const Pair* pairs;
  const std::int32_t* edges_begin;  ///< [vertices + 1] by elimination index
  const std::int32_t* edges;        ///< slot * 2 + (1: the vertex is `to`)
  const std::int32_t* pose_of;      ///< [vertices]
  const std::int32_t* from;         ///< [slots] poses
  const std::int32_t* to;
  const std::int32_t* edge_of_slot;
  // Numbers of the problem, by edge.
  const double* measurement;        ///< [edges][8]
  const std::int32_t* information;  ///< [edges] matrix * 2 + (1: robust), -1: rejected
  const double* matrices;           ///< [matrices][28] packed lower triangles
  int robust_kernel;
  double robust_width;
  // State. `poses` and `normal` are those of the present, `next_*` those after the step.
  const double* poses;  ///< [poses][8]
  double* next_poses;
  const double* normal;  ///< [slots][stride], see Model<M>::kStride
  double* next_normal;
  double* squared;  ///< [slots] squared residuals, before the robust kernel
  // Work.
  double* panel;  ///< L of all fronts, with inverted diagonal; row (pivots + below) is L^-1 b
  double* schur;
  double* rhs;
  double* step;                ///< [vertices * block size]
  double* front_norm;          ///< [fronts]
  double* chunk_cost;          ///< [chunks of kChunk slots]
  std::int32_t* front_done;    ///< signals counted since the structure was made
  std::int32_t* tile_done;     ///< epoch
  std::int32_t* descent_done;  ///< [fronts] epoch
  std::int32_t* forward_done;  ///< [fronts] epoch
  std::int32_t* tickets;       ///< [4]
  std::int32_t* failed;        ///< epoch of the last factorisation that failed
  int factor_epoch, forward_epoch, descent_epoch;
  double lambda;
};

/// Slots whose costs are summed together.
inline constexpr int kChunk = 128;

}  // namespace fastloop::optimization::device
