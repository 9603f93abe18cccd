#pragma once

#include "fastloop/compute/host_device.hpp"
#include "fastloop/features/hamming.hpp"

namespace fastloop::matching {

/// Hamming distances of a batch, portable: the reference executor and device code.
struct PortableDistances {
  FASTLOOP_HD void operator()(const Descriptor& query, const Descriptor* all,
                              const std::uint16_t* indices, int n, std::uint16_t* out) const {
    for (int i = 0; i < n; ++i)
      out[i] = static_cast<std::uint16_t>(hamming_distance(query, all[indices[i]]));
  }
};

/// The same with the population count of the CPU at hand.
struct CpuDistances {
  void operator()(const Descriptor& query, const Descriptor* all, const std::uint16_t* indices,
                  int n, std::uint16_t* out) const {
    if (n > 0) hamming_distances(query, all, {indices, static_cast<std::size_t>(n)}, out);
  }
};

}  // namespace fastloop::matching
