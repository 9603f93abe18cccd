#pragma once

#include <map>
#include <mutex>
#include <string>
#include <vector>

#include "fastloop/core/time.hpp"

namespace fastloop {

/// Order statistics of one stage, milliseconds. Percentiles are nearest-rank.
struct StageStatistics {
  std::size_t count = 0;
  double mean_ms = 0, p50_ms = 0, p95_ms = 0, p99_ms = 0, max_ms = 0;
};

StageStatistics summarize(std::vector<double> samples_ms);

/// Collects durations by stage name. Thread-safe.
class StageTimes {
 public:
  void add(const std::string& stage, double ms);
  std::map<std::string, StageStatistics> statistics() const;
  std::vector<double> samples(const std::string& stage) const;

 private:
  mutable std::mutex mutex_;
  std::map<std::string, std::vector<double>> samples_;
};

/// Adds the life time of the object to `times[stage]`; does nothing when `times` is null.
class ScopedTimer {
 public:
  ScopedTimer(StageTimes* times, std::string stage) : times_(times), stage_(std::move(stage)) {}
  ~ScopedTimer() {
    if (times_) times_->add(stage_, watch_.elapsed_ms());
  }
  ScopedTimer(const ScopedTimer&) = delete;
  ScopedTimer& operator=(const ScopedTimer&) = delete;

 private:
  StageTimes* times_;
  std::string stage_;
  Stopwatch watch_;
};

}  // namespace fastloop
