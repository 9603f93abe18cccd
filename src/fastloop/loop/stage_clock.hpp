#pragma once

#include <string>
#include <utility>
#include <vector>

#include "fastloop/core/time.hpp"

namespace fastloop::loop {

/// Times of the stages of one call, in the order they ended; a stage that comes again adds up.
class StageClock {
 public:
  /// Ends a stage: everything since the last call belongs to it.
  void lap(const std::string& stage) {
    const double now = watch_.elapsed_ms(), ms = now - last_;
    last_ = now;
    for (auto& [name, sum] : times_)
      if (name == stage) {
        sum += ms;
        return;
      }
    times_.emplace_back(stage, ms);
  }
  const std::vector<std::pair<std::string, double>>& times_ms() const { return times_; }

 private:
  Stopwatch watch_;
  double last_ = 0;
  std::vector<std::pair<std::string, double>> times_;
};

}  // namespace fastloop::loop
