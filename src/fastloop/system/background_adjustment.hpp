#pragma once

#include <atomic>
#include <exception>
#include <memory>
#include <optional>
#include <thread>

#include "fastloop/map/correction.hpp"
#include "fastloop/mapping/options.hpp"

namespace fastloop::system {

/// Adjusts a whole map beside everything else, after a loop. One at a time; the result is a
/// correction for whatever the map has become meanwhile.
class BackgroundAdjustment {
 public:
  /// @param threaded  false: `start` does all the work before it returns
  BackgroundAdjustment(const mapping::MappingOptions& options, bool threaded)
      : options_(options), threaded_(threaded) {}
  ~BackgroundAdjustment() { cancel(); }

  /// Begins with a version of the map; what ran before is cancelled.
  void start(std::shared_ptr<const map::Snapshot> snapshot, MapId map, bool inertial);
  /// Abandons what is running; returns when it has stopped.
  void cancel();
  bool running() const { return running_; }
  bool ready() const { return running_ && done_; }
  /// Waits for the result and takes it; nothing when it is not better than what was there. Rethrows
  /// an exception of the thread.
  std::optional<map::LoopCorrection> take();

 private:
  void adjust(const map::Snapshot& snapshot, MapId map, bool inertial);

  mapping::MappingOptions options_;
  const bool threaded_;
  bool running_ = false;
  std::atomic<bool> cancel_{false}, done_{false};
  std::optional<map::LoopCorrection> result_;
  std::exception_ptr error_;
  std::jthread thread_;
};

}  // namespace fastloop::system
