#include "fastloop/eval/statistics.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <numeric>

#include "fastloop/core/error.hpp"

namespace fastloop::eval {

SampleStatistics describe(std::vector<double> values) {
  SampleStatistics s;
  s.count = values.size();
  if (values.empty()) return s;
  for (const double v : values)
    if (!std::isfinite(v)) throw InvalidArgument("describe: a measurement is not finite");
  std::sort(values.begin(), values.end());
  const auto n = static_cast<double>(values.size());
  s.min = values.front();
  s.max = values.back();
  s.mean = std::accumulate(values.begin(), values.end(), 0.0) / n;
  const std::size_t half = values.size() / 2;
  s.median = values.size() % 2 ? values[half] : (values[half - 1] + values[half]) / 2;
  double squares = 0;
  for (const double v : values) squares += (v - s.mean) * (v - s.mean);
  if (values.size() > 1) s.sd = std::sqrt(squares / (n - 1));
  return s;
}

std::vector<std::vector<TimedStages>> measure_in_turn(std::span<const TimedSource> sources,
                                                      int warm_up, int runs) {
  if (warm_up < 0 || runs < 1)
    throw InvalidArgument("measure_in_turn: at least one run, and no negative warm-up");
  std::vector<std::vector<TimedStages>> measured(sources.size());
  for (int round = -warm_up; round < runs; ++round) {
    for (std::size_t i = 0; i < sources.size(); ++i) {
      TimedStages once = sources[i]();
      if (round >= 0) measured[i].push_back(std::move(once));
    }
  }
  return measured;
}

std::optional<std::string> sum_mismatch(const StageList& stages_ms, double total_ms,
                                        double tolerance) {
  constexpr double kClockMs = 0.05;
  double sum = 0;
  for (const auto& [stage, ms] : stages_ms) sum += ms;
  if (std::abs(sum - total_ms) <= std::max(kClockMs, tolerance * std::abs(total_ms)))
    return std::nullopt;
  char text[160];
  std::snprintf(text, sizeof text,
                "stages sum to %.3f ms, the whole took %.3f ms: %+.1f %%, allowed %.1f %%", sum,
                total_ms, 100 * (sum / total_ms - 1), 100 * tolerance);
  return text;
}

double slope(std::span<const double> x, std::span<const double> y) {
  if (x.size() != y.size()) throw InvalidArgument("slope: as many x as y");
  if (x.empty()) return 0;
  const auto n = static_cast<double>(x.size());
  const double mean_x = std::accumulate(x.begin(), x.end(), 0.0) / n;
  const double mean_y = std::accumulate(y.begin(), y.end(), 0.0) / n;
  double xx = 0, xy = 0;
  for (std::size_t i = 0; i < x.size(); ++i) {
    xx += (x[i] - mean_x) * (x[i] - mean_x);
    xy += (x[i] - mean_x) * (y[i] - mean_y);
  }
  return xx > 0 ? xy / xx : 0;
}

}  // namespace fastloop::eval
