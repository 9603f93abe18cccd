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
  __device__ double sum(double value) const {
    for (int offset = 16; offset > 0; offset /= 2)
      value += __shfl_xor_sync(0xffffffffu, value, offset);
    return value;
  }
  /// Of memory that another block wrote in this launch: past the first cache, which may be stale.
  __device__ double load(const double* p) const { return __ldcg(p); }
  __device__ void wait(const std::int32_t* counter, int value) const {
    int seen;
    do {
      asm volatile("ld.acquire.gpu.global.s32 %0, [%1];" : "=r"(seen) : "l"(counter) : "memory");
    } while (seen < value);
  }
  __device__ void signal(std::int32_t* counter) const {
    __syncthreads();
    if (threadIdx.x == 0) {
      __threadfence();
      asm volatile("red.release.gpu.global.add.s32 [%0], 1;" ::"l"(counter) : "memory");
    }
  }
  __device__ void publish(std::int32_t* flag, int value) const {
    __syncthreads();
    if (threadIdx.x == 0) {
      __threadfence();
      asm volatile("st.release.gpu.global.s32 [%0], %1;" ::"l"(flag), "r"(value) : "memory");
    }
  }

  /// Product of tiles in registers, 4 x 4 numbers a thread: takes 256 threads.
  struct TileSum {
    double acc[4][4];
    LaneTile tile;
    __device__ explicit TileSum(const BlockTeam& team)
        : acc{}, tile(team.lane(), 32 * (team.warp() % 2), 16 * (team.warp() / 2)) {}
    __device__ void add_product(const Square& x, const Square& y, const Square&) {
#pragma unroll 4
      for (int k = 0; k < kTileDepth; ++k) {
        double a[4], b[4];
        const double *row = x.column(k), *column = y.column(k);
        load_pair(row + tile.row[0], a[0], a[1]);
        load_pair(row + tile.row[2], a[2], a[3]);
        load_pair(column + tile.column[0], b[0], b[1]);
        load_pair(column + tile.column[2], b[2], b[3]);
#pragma unroll
        for (int c = 0; c < 4; ++c)
#pragma unroll
          for (int r = 0; r < 4; ++r) acc[c][r] += a[r] * b[c];
      }
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
  __shared__ double shared[kChunk / 32];
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
