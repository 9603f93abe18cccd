#pragma once

#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

namespace fastloop::eval {

/// Milliseconds by stage, in order.
using StageList = std::vector<std::pair<std::string, double>>;

/// Repeated measurements of one quantity, in its unit. All zero when there are none.
struct SampleStatistics {
  std::size_t count = 0;
  double mean = 0;
  double sd = 0;  ///< of the sample (divided by count - 1); 0 for a single measurement
  double median = 0, min = 0, max = 0;
  double spread() const { return max - min; }
};

/// @throws InvalidArgument when a measurement is not finite
SampleStatistics describe(std::vector<double> measurements);

/// One repetition of something that measures its own stages and, independently, the whole.
struct TimedStages {
  StageList stages_ms;
  double total_ms = 0;
};
using TimedSource = std::function<TimedStages()>;

/// Repeats several sources in turn, so that what else the machine does hits all of them alike. The
/// first `warm_up` rounds are run and dropped.
/// @return [sources][runs]
std::vector<std::vector<TimedStages>> measure_in_turn(std::span<const TimedSource> sources,
                                                      int warm_up, int runs);

inline constexpr double kSumTolerance = 0.02;

/// What is wrong when stages do not sum to the total within the tolerance (relative, and at least
/// 0.05 ms, below which the clock's own calls count): something is measured twice, or not at all.
std::optional<std::string> sum_mismatch(const StageList& stages_ms, double total_ms,
                                        double tolerance = kSumTolerance);

/// Slope of the least-squares line through points, y per x; 0 when all x are equal.
/// @throws InvalidArgument on unequal sizes
double slope(std::span<const double> x, std::span<const double> y);

}  // namespace fastloop::eval
