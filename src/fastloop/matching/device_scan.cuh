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

}  // namespace fastloop::matching
