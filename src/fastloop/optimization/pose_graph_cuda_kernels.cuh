#pragma once

#include "fastloop/optimization/pose_graph_device_passes.hpp"

/// Kernels around the functions of pose_graph_device_*.hpp. Blocks take tasks from a queue whose
/// order puts whatever a task waits for before it; so the blocks that run always get on, however
/// few they are.
namespace fastloop::optimization::device {

inline constexpr int kFactorThreads = 256;
inline constexpr int kSolveThreads = 128;

/// A block of the device.
struct BlockTeam {
  __device__ int rank() const { return static_cast<int>(threadIdx.x); }
  __device__ int size() const { return static_cast<int>(blockDim.x); }
  __device__ int lane() const { return static_cast<int>(threadIdx.x) % 32; }
  __device__ int lanes() const { return 32; }
  __device__ int warp() const { return static_cast<int>(threadIdx.x) / 32; }
  __device__ int warps() const { return static_cast<int>(blockDim.x) / 32; }
  __device__ void sync() const { __syncthreads(); }
  __device__ void sync_warp() const { __syncwarp(); }
  __device__ double sum(double value) const {
    for (int offset = 16; offset > 0; offset /= 2)
      value += __shfl_xor_sync(0xffffffffu, value, offset);
    return value;
  }
  /// Of memory that another block wrote in this launch: past the first cache, which may be stale.
  __device__ double load(const double* p) const { return __ldcg(p); }
  /// Into shared memory; there after finish_copies() of the same thread.
  __device__ void copy(double* to, const double* from) const {
    const auto address = static_cast<std::uint32_t>(__cvta_generic_to_shared(to));
    asm volatile("cp.async.ca.shared.global [%0], [%1], 8;" ::"r"(address), "l"(from) : "memory");
  }
  __device__ void finish_copies() const { asm volatile("cp.async.wait_all;" ::: "memory"); }
  __device__ void wait(const std::int32_t* counter, int value) const {
    int seen;
    do {
      asm volatile("ld.acquire.gpu.global.s32 %0, [%1];" : "=r"(seen) : "l"(counter) : "memory");
    } while (seen < value);
  }
  __device__ void signal(std::int32_t* counter) const {
    __syncthreads();
    if (threadIdx.x == 0) {
      asm volatile("red.release.gpu.global.add.s32 [%0], 1;" ::"l"(counter) : "memory");
    }
  }
  __device__ void publish(std::int32_t* flag, int value) const {
    __syncthreads();
    if (threadIdx.x == 0) {
      asm volatile("st.release.gpu.global.s32 [%0], %1;" ::"l"(flag), "r"(value) : "memory");
    }
  }

  /// The calling warp: x <- T^-1 x. T is lower triangular with inverted diagonal, column-major;
  /// width <= kStrip. A lane holds a row of T, divided by its diagonal.
  __device__ void solve_lower(const double* t, int stride, int width, double* x) const {
    const int r = lane();
    const double inverse = r < width ? t[static_cast<long long>(r) * stride + r] : 0.0;
    double row[kStrip], value = r < width ? x[r] * inverse : 0.0;
#pragma unroll
    for (int c = 0; c < kStrip; ++c)
      row[c] = c < r && r < width ? t[static_cast<long long>(c) * stride + r] * inverse : 0.0;
#pragma unroll
    for (int c = 0; c < kStrip - 1; ++c)
      if (c < width - 1) value -= row[c] * __shfl_sync(0xffffffffu, value, c);
    if (r < width) x[r] = value;
  }
  /// x <- T^-T x.
  __device__ void solve_upper(const double* t, int stride, int width, double* x) const {
    const int c = lane();
    const double* own = t + static_cast<long long>(c) * stride;
    const double inverse = c < width ? own[c] : 0.0;
    double column[kStrip], value = c < width ? x[c] * inverse : 0.0;
#pragma unroll
    for (int r = 0; r < kStrip; ++r) column[r] = c < r && r < width ? own[r] * inverse : 0.0;
#pragma unroll
    for (int r = kStrip - 1; r > 0; --r)
      if (r < width) value -= column[r] * __shfl_sync(0xffffffffu, value, r);
    if (c < width) x[c] = value;
  }

  /// Product of tiles in registers, 4 x 4 numbers a thread: takes 256 threads.
  struct TileSum {
    double acc[4][4];
    LaneTile tile;
    __device__ explicit TileSum(const BlockTeam& team)
        : acc{}, tile(team.lane(), 32 * (team.warp() % 2), 16 * (team.warp() / 2)) {}
    __device__ void add_product(const Square& x, const Square& y, const Square&) {
      multiply_tile(x, kTileRows, y, kTileRows, 0, kTileDepth, tile, acc);
    }
    __device__ void subtract_from(const Square& c) const {
#pragma unroll
      for (int k = 0; k < 4; ++k)
#pragma unroll
        for (int r = 0; r < 4; ++r) c.column(tile.column[k])[tile.row[r]] -= acc[k][r];
    }
  };
};

/// Calls f(task) for tasks from the queue until it is empty. The next one is drawn while the
/// present one is worked on.
template <class F>
__device__ void work_off(std::int32_t* ticket, int count, F f) {
  __shared__ int task;
  int next = 0;
  if (threadIdx.x == 0) task = atomicAdd(ticket, 1);
  for (;;) {
    __syncthreads();
    const int now = task;
    if (now >= count) return;
    if (threadIdx.x == 0) next = atomicAdd(ticket, 1);
    f(now);
    __syncthreads();
    if (threadIdx.x == 0) task = next;
  }
}

template <EdgeModel M>
__global__ void __launch_bounds__(kFactorThreads) factor_kernel(const View v) {
  extern __shared__ double2 memory[];
  double* shared = reinterpret_cast<double*>(memory);
  work_off(v.tickets, v.num_tasks, [&](int k) {
    const Task task = v.tasks[k];
    if (v.fronts[task.front].tiled) {
      factor_tile<M>(BlockTeam(), v, task, shared);
    } else {
      factor_front<M>(BlockTeam(), v, task.front, shared);
    }
  });
}

template <EdgeModel M>
__global__ void __launch_bounds__(kSolveThreads) forward_kernel(const View v, int doubles) {
  extern __shared__ double2 memory[];
  double* shared = reinterpret_cast<double*>(memory);
  work_off(v.tickets + 1, v.num_fronts,
           [&](int k) { forward_front<M>(BlockTeam(), v, v.ascent[k], shared, doubles); });
}

template <EdgeModel M>
__global__ void __launch_bounds__(kSolveThreads) backward_kernel(const View v, int doubles) {
  extern __shared__ double2 memory[];
  double* shared = reinterpret_cast<double*>(memory);
  work_off(v.tickets + 2, v.num_fronts,
           [&](int k) { backward_front<M>(BlockTeam(), v, v.descent[k], shared, doubles); });
}

/// Linearises all edges; the block that ends last adds up the costs and hands the result to the
/// host, through memory that the host reads while it waits.
template <EdgeModel M>
__global__ void __launch_bounds__(kChunk)
    linearize_kernel(const View v, const double* poses, double* normal, volatile StepResult* result,
                     int sequence) {
  __shared__ double shared[kChunk / 32 + kChunk * Model<M>::kStride];
  __shared__ bool last;
  const BlockTeam team;
  if (v.num_slots > 0)
    linearize_chunk<M>(team, v, static_cast<int>(blockIdx.x), poses, normal, shared);
  if (threadIdx.x == 0) {
    __threadfence();
    last = atomicAdd(v.tickets + 3, 1) == static_cast<int>(gridDim.x) - 1;
    __threadfence();
  }
  __syncthreads();
  if (!last) return;
  const int chunks = (v.num_slots + kChunk - 1) / kChunk;
  const double cost = 0.5 * total(team, v.chunk_cost, chunks, shared);
  const double norm = total(team, v.front_norm, v.num_fronts, shared);
  if (threadIdx.x < 4) v.tickets[threadIdx.x] = 0;  // for the launches that follow
  if (threadIdx.x == 0) {
    result->cost = cost;
    result->squared_norm = norm;
    result->positive_definite = *v.failed != v.factor_epoch;
    __threadfence_system();
    result->sequence = sequence;
  }
}

}  // namespace fastloop::optimization::device
