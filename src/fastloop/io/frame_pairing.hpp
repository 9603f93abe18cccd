#pragma once

#include <span>
#include <vector>

#include "fastloop/core/time.hpp"

namespace fastloop::io {

struct IndexPair {
  std::size_t left = 0, right = 0;
};

/// Pairs each left stamp with the right stamp nearest to it, when each is the other's nearest and
/// they differ by at most `tolerance_ns`. Both lists strictly increase; so do the pairs.
std::vector<IndexPair> pair_by_time(std::span<const Nanoseconds> left,
                                    std::span<const Nanoseconds> right, Nanoseconds tolerance_ns);

/// Median difference between neighbouring stamps; 0 for fewer than two.
Nanoseconds median_gap_ns(std::span<const Nanoseconds> stamps);

/// Half the usual frame gap, so that a frame never takes its neighbour's partner, but at most
/// `limit_ns`.
Nanoseconds pairing_tolerance_ns(std::span<const Nanoseconds> left,
                                 std::span<const Nanoseconds> right, Nanoseconds limit_ns);

}  // namespace fastloop::io
