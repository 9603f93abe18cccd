#pragma once

#include "fastloop/matching/packed_features.hpp"

/// What the kernels of this folder share.
namespace fastloop::matching {

/// Hamming distances from one descriptor, which stays in registers.
class DeviceDistance {
 public:
  __device__ DeviceDistance(const Descriptor* query, const Descriptor* all)
      : low_(words(query)[0]), high_(words(query)[1]), all_(all) {}
  __device__ int operator()(int i) const {
    const uint4 low = __ldg(words(all_ + i)), high = __ldg(words(all_ + i) + 1);
    return __popc(low.x ^ low_.x) + __popc(low.y ^ low_.y) + __popc(low.z ^ low_.z) +
           __popc(low.w ^ low_.w) + __popc(high.x ^ high_.x) + __popc(high.y ^ high_.y) +
           __popc(high.z ^ high_.z) + __popc(high.w ^ high_.w);
  }

 private:
  static __device__ const uint4* words(const Descriptor* d) {
    return reinterpret_cast<const uint4*>(d);
  }
  uint4 low_, high_;
  const Descriptor* all_;
};

/// Merges what the lanes of a group found; all of them get the result. Groups are `lanes`
/// consecutive threads, a power of two, and all of them take part.
template <int kLanes>
__device__ BestTwo merged(BestTwo found) {
  const unsigned first = threadIdx.x % 32 / kLanes * kLanes;
  const unsigned mask = (kLanes == 32 ? ~0u : (1u << kLanes) - 1) << first;
  for (int distance = kLanes / 2; distance > 0; distance /= 2) {
    const BestTwo other{__shfl_xor_sync(mask, found.best, distance),
                        __shfl_xor_sync(mask, found.second, distance)};
    found.merge(other);
  }
  return found;
}

__device__ inline void prefetch(const void* memory) {
  asm volatile("prefetch.global.L1 [%0];" ::"l"(memory));
}

/// Calls write(place, k, claim[k]) for every k < n that has a claim, places in ascending order of k,
/// and sets all bits of the claims again. All kThreads threads of the block take part.
/// @return number of claims
template <int kThreads, class Claim, class Write>
__device__ int take_claims(Claim* claim, int n, const Write& write) {
  constexpr int kWarps = kThreads / 32, kRounds = 4;  // loads on the way at once
  constexpr Claim kNone = ~Claim{0};
  __shared__ int found_by_warp[kRounds][kWarps];
  const int lane = static_cast<int>(threadIdx.x) % 32, warp = static_cast<int>(threadIdx.x) / 32;
  int written = 0;
  for (int first = 0; first < n; first += kRounds * kThreads) {
    Claim mine[kRounds];
    unsigned votes[kRounds];
#pragma unroll
    for (int r = 0; r < kRounds; ++r) {
      const int k = first + r * kThreads + static_cast<int>(threadIdx.x);
      mine[r] = k < n ? __ldcg(claim + k) : kNone;
    }
#pragma unroll
    for (int r = 0; r < kRounds; ++r) {
      const int k = first + r * kThreads + static_cast<int>(threadIdx.x);
      if (mine[r] != kNone) claim[k] = kNone;
      votes[r] = __ballot_sync(~0u, mine[r] != kNone);
      if (lane == 0) found_by_warp[r][warp] = __popc(votes[r]);
    }
    __syncthreads();
#pragma unroll
    for (int r = 0; r < kRounds; ++r) {
      int place = written + __popc(votes[r] & ((1u << lane) - 1));
      for (int w = 0; w < kWarps; ++w) {
        if (w < warp) place += found_by_warp[r][w];
        written += found_by_warp[r][w];
      }
      if (mine[r] != kNone)
        write(place, first + r * kThreads + static_cast<int>(threadIdx.x), mine[r]);
    }
    __syncthreads();
  }
  return written;
}

}  // namespace fastloop::matching
