#pragma once

#include <condition_variable>
#include <exception>
#include <memory>
#include <mutex>
#include <thread>

#include "fastloop/core/bounded_queue.hpp"
#include "fastloop/mapping/mapper.hpp"

namespace fastloop::system {

/// Runs a Mapper behind a bounded queue in a thread of its own, or in the caller's thread.
class MappingWorker {
 public:
  /// @param threaded  false: `submit` does all the work before it returns
  MappingWorker(const StereoRig& rig, const PyramidScales& scales,
                const mapping::MappingOptions& options, bool threaded,
                std::function<void(Nanoseconds, const mapping::ImuStep&)> imu_event,
                StageTimes* times);
  ~MappingWorker();

  /// Hands a request over; waits while the queue is full. With `wait`, until it has been processed.
  /// Rethrows an exception of the worker.
  void submit(map::KeyframeRequest request, bool wait);
  /// Processes what is queued and ends the thread. Rethrows an exception of the worker.
  void finish();

  bool idle() const;
  bool full() const { return threaded_ && queue_.full(); }
  std::shared_ptr<const map::Snapshot> snapshot() const;

 private:
  void run();
  void rethrow();

  const bool threaded_;
  mutable std::mutex mutex_;
  std::condition_variable done_;
  std::shared_ptr<const map::Snapshot> snapshot_;
  std::exception_ptr error_;
  std::size_t submitted_ = 0, processed_ = 0;
  BoundedQueue<map::KeyframeRequest> queue_{3};
  mapping::Mapper mapper_;
  std::jthread thread_;
};

}  // namespace fastloop::system
