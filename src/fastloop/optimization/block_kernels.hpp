#pragma once

#include <cstddef>
#include <cstdint>

/// The inner loops of the block pose-graph solver. They are written once (block_*.inl) and compiled
/// for several instruction sets (block_kernels_*.cpp); the machine picks one at run time. These
/// structs hold plain pointers only, so that no inline library function is ever compiled with
/// instructions that the machine may lack.
namespace fastloop::optimization::block {

/// Edges are stored and linearised in batches of this many, one SIMD lane each.
inline constexpr int kLanes = 8;
/// Rows of matrices in memory are padded to this.
inline constexpr int kRowAlign = 8;

enum class EdgeModel : int { kYaw, kSe3, kSim3, kSim3FixedScale };
inline constexpr int kNumEdgeModels = 4;

/// Edges in the order in which the elimination consumes them, as [batch][field][lane].
/// Measurement fields, quaternions as (x, y, z, w):
///   kYaw          conjugate of the measured rotation (4), translation (3), unused
///   others        inverse of the measurement: rotation (4), translation (3), scale
struct EdgeBatches {
  const std::int32_t* from = nullptr;  ///< [slots] pose
  const std::int32_t* to = nullptr;
  const double* measurement = nullptr;
  const std::uint8_t* full_information =
      nullptr;  ///< [batches] packed lower triangle, else diagonal only
  const std::size_t* information_offset = nullptr;  ///< [batches] into `information`
  const double* information = nullptr;
  const double* robust = nullptr;  ///< [slots] 1 where the robust kernel applies, else 0
};

/// Exact residual and derivative of one edge for residuals too large for the power series of the
/// vector code. `residual` 7 numbers, `jacobian` 7 x 7 column-major.
using ExactEdge = void (*)(EdgeModel model, const double* from, const double* to,
                           const double* measurement, double* residual, double* jacobian);
/// rho(squared) and its derivative.
using ExactRobust = void (*)(int kernel, double width, double squared, double* cost,
                             double* weight);

/// What every kernel of one pass needs.
struct PassContext {
  const double* poses = nullptr;  ///< [n][8] quaternion (x, y, z, w), translation, scale
  EdgeBatches edges;
  int robust_kernel = 0;
  double robust_width = 1;
  ExactEdge exact_edge = nullptr;
  ExactRobust exact_robust = nullptr;
  double lambda = 0;  ///< damping
  const double* damping =
      nullptr;  ///< [free vertices][28] packed metric of the damping, elimination order
};

/// Blocks of a child's update matrix that are consecutive in the parent, too.
struct Run {
  std::int32_t first, count;
};

struct ChildView {
  const double* schur = nullptr;  ///< of all fronts in reach of any thread, or null
  /// Row 0, column 0 of the child's update matrix in that memory, or in the scratch.
  std::size_t schur_offset = 0;
  int stride = 0;
  int blocks = 0;                          ///< without the right-hand side
  const std::int32_t* position = nullptr;  ///< [blocks] in the parent front
  const Run* runs = nullptr;
  int num_runs = 0;
  const double* rhs = nullptr;  ///< forward pass: [blocks * D]
};

/// One front: `pivots` block columns to eliminate and `below` more block rows. Row `(pivots +
/// below) * D` carries the right-hand side. After the factorisation the panel holds L (with
/// inverted diagonal) and in its last row L^-1 b.
struct FrontView {
  double* panel = nullptr;  ///< [pivots * D columns] of stride panel_stride
  int panel_stride = 0;
  double* schur = nullptr;       ///< [below * D columns], row 0 is front row `schur_first_row`;
                                 ///< null: in the scratch of the thread
  std::size_t schur_offset = 0;  ///< into that scratch
  int schur_stride = 0;
  int schur_first_row = 0;  ///< a multiple of kRowAlign
  int pivots = 0, below = 0;
  int first_vertex = 0;                        ///< elimination index of the first pivot
  std::size_t edges_begin = 0, edges_end = 0;  ///< slots
  const std::int32_t* edge_position =
      nullptr;  ///< [slots][2] block of from and to in this front or -1
  const ChildView* children = nullptr;
  int num_children = 0;
  double* rhs = nullptr;  ///< forward pass: [below * D] out
};

/// Batch linearised last; a task's fronts consume edges in order, so each batch is computed once.
struct BatchCursor {
  std::ptrdiff_t batch = -1;
  alignas(64) double hessian[28 * kLanes];  ///< packed lower triangle of J_to^T W J_to
  alignas(64) double gradient[7 * kLanes];  ///< J_to^T W r
};

struct ModelKernels {
  /// Assembles a front from edges, damping and children, and eliminates its pivots. False: not
  /// positive definite. `scratch` holds the update matrices of the task at hand.
  bool (*factor)(const PassContext&, const FrontView&, BatchCursor&, double* scratch) = nullptr;
  /// Right-hand side only, with the factor of an earlier `factor`: refreshes the last row of the
  /// panel.
  void (*forward)(const PassContext&, const FrontView&, BatchCursor&, double* work) = nullptr;
  /// x: [pivots + below blocks] of this front, the part below given, the pivots computed. Returns
  /// the squared norm of this front's part of L^-1 b.
  double (*backward)(const FrontView&, double* x) = nullptr;
  /// Sum of rho(squared residual) over a range of batches, in order; per slot squared residuals
  /// when not null.
  double (*cost)(const PassContext&, std::size_t batch_begin, std::size_t batch_end,
                 double* squared) = nullptr;
  /// Linearises one batch (tests, measurements).
  void (*linearize)(const PassContext&, BatchCursor&, std::ptrdiff_t batch) = nullptr;
};

struct KernelSet {
  const char* name;
  ModelKernels model[kNumEdgeModels];
};

const KernelSet& portable_kernels();
#if defined(__x86_64__)
const KernelSet& avx2_kernels();
const KernelSet& avx512_kernels();
#endif

}  // namespace fastloop::optimization::block
