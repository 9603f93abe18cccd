#include "fastloop/system/mapping_worker.hpp"

namespace fastloop::system {

MappingWorker::MappingWorker(const StereoRig& rig, const PyramidScales& scales,
                             const mapping::MappingOptions& options, bool threaded,
                             std::function<void(Nanoseconds, const mapping::ImuStep&)> imu_event,
                             StageTimes* times)
    : threaded_(threaded),
      mapper_(rig, scales, options,
              {[this](std::shared_ptr<const map::Snapshot> snapshot) {
                 const std::lock_guard lock(mutex_);
                 snapshot_ = std::move(snapshot);
               },
               std::move(imu_event)},
              times) {
  snapshot_ = mapper_.map().publish();
  if (threaded_) thread_ = std::jthread([this] { run(); });
}

MappingWorker::~MappingWorker() {
  mapper_.cancel();
  queue_.close();
}

void MappingWorker::run() {
  try {
    while (const auto request = queue_.pop()) {
      mapper_.process(*request, queue_.size() > 1);
      const std::lock_guard lock(mutex_);
      ++processed_;
      done_.notify_all();
    }
  } catch (...) {
    queue_.close();
    const std::lock_guard lock(mutex_);
    error_ = std::current_exception();
    done_.notify_all();
  }
}

void MappingWorker::submit(map::KeyframeRequest request, bool wait) {
  if (!threaded_) {
    mapper_.process(request, false);
    return;
  }
  rethrow();
  std::size_t ticket;
  {
    const std::lock_guard lock(mutex_);
    ticket = ++submitted_;
  }
  queue_.push(std::move(request));
  if (wait) {
    std::unique_lock lock(mutex_);
    done_.wait(lock, [&] { return error_ || processed_ >= ticket; });
  }
  rethrow();
}

void MappingWorker::finish() {
  if (threaded_ && thread_.joinable()) {
    queue_.close();
    thread_.join();
  }
  rethrow();
}

bool MappingWorker::idle() const {
  const std::lock_guard lock(mutex_);
  return submitted_ == processed_;
}

std::shared_ptr<const map::Snapshot> MappingWorker::snapshot() const {
  const std::lock_guard lock(mutex_);
  return snapshot_;
}

void MappingWorker::rethrow() {
  std::exception_ptr error;
  {
    const std::lock_guard lock(mutex_);
    error = error_;
  }
  if (error) std::rethrow_exception(error);
}

}  // namespace fastloop::system
