#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "fastloop/io/trajectory.hpp"

namespace fastloop::eval {

inline constexpr Nanoseconds kMaxTimeDifferenceNs = 10'000'000;

/// Indices of two poses taken at the same time.
struct Match {
  std::size_t reference = 0, estimate = 0;
  bool operator==(const Match&) const = default;
};

/// Pairs two trajectories by time, by the rule of the tool evo: each pose of the trajectory with
/// fewer poses (the estimate when equal) takes the nearest pose of the other, the earlier one of
/// two equally near, if it is at most `max_difference_ns` away. Stamps must increase; the result is
/// ordered by time.
std::vector<Match> associate(std::span<const io::StampedPose> reference,
                             std::span<const io::StampedPose> estimate,
                             Nanoseconds max_difference_ns = kMaxTimeDifferenceNs);

/// Share of the reference's poses, 0 to 1, that lie no further from a pose of the estimate than
/// the usual (median) step between poses of the estimate.
double time_coverage(std::span<const io::StampedPose> reference,
                     std::span<const io::StampedPose> estimate);

}  // namespace fastloop::eval
