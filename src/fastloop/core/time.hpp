#pragma once

#include <chrono>
#include <cmath>
#include <cstdint>

namespace fastloop {

/// Time stamps are integer nanoseconds in the clock of the data set (`stamp_ns`).
using Nanoseconds = std::int64_t;

constexpr double to_seconds(Nanoseconds ns) {
  return static_cast<double>(ns) * 1e-9;
}
inline Nanoseconds from_seconds(double s) {
  return std::llround(s * 1e9);
}

/// Wall clock for stage times: elapsed milliseconds since construction or the last `restart()`.
class Stopwatch {
 public:
  double elapsed_ms() const {
    return std::chrono::duration<double, std::milli>(Clock::now() - start_).count();
  }
  void restart() { start_ = Clock::now(); }

 private:
  using Clock = std::chrono::steady_clock;
  Clock::time_point start_ = Clock::now();
};

}  // namespace fastloop
