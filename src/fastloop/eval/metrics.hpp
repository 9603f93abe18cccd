#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "fastloop/io/trajectory.hpp"

namespace fastloop::eval {

/// Summary of a list of errors, in their unit. All zero when there are none.
struct Statistics {
  std::size_t count = 0;
  double rmse = 0, mean = 0, median = 0;
  double std = 0;  ///< of the population (divided by count)
  double min = 0, max = 0;
};

Statistics summarize_errors(std::vector<double> errors);

/// Distance of the positions, metres, [n]; the absolute trajectory error of each pose.
std::vector<double> position_errors(std::span<const SE3> reference, std::span<const SE3> estimate);

/// Which pairs of poses the relative pose error compares.
enum class RpePairs {
  kAll,          ///< every pose with the one `delta` later (TUM's definition; evo --all_pairs)
  kConsecutive,  ///< a chain of steps of length `delta` from the first pose (evo's default)
};

struct IndexPair {
  std::size_t first = 0, second = 0;
  bool operator==(const IndexPair&) const = default;
};

/// Pairs of poses `delta_ns` apart: the second is the pose nearest to that time, and a pair further
/// from `delta_ns` than half the usual (median) step is left out, so gaps make no pairs.
/// With a constant rate this equals evo's pairs of `delta * rate` frames.
std::vector<IndexPair> pairs_in_time(std::span<const Nanoseconds> stamps_ns, Nanoseconds delta_ns,
                                     RpePairs which);

struct RelativeErrors {
  std::vector<double> translation_m, rotation_deg;  ///< [pairs]
};

/// Relative pose error (Sturm et al., IROS 2012): for each pair, the motion (Q_i^-1 Q_j)^-1 (P_i^-1
/// P_j) with reference Q and estimate P.
RelativeErrors relative_errors(std::span<const SE3> reference, std::span<const SE3> estimate,
                               std::span<const IndexPair> pairs);

/// Sum of the distances between neighbouring positions, metres.
double path_length(std::span<const SE3> poses);

}  // namespace fastloop::eval
