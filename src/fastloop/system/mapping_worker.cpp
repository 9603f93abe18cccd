#include "fastloop/system/mapping_worker.hpp"

#include <algorithm>

namespace fastloop::system {

MappingWorker::MappingWorker(const StereoRig& rig, const PyramidScales& scales,
                             const mapping::MappingOptions& options, const WorkerPace& pace,
                             const LoopClosingOptions& loops, Callbacks callbacks,
                             std::shared_ptr<const map::Snapshot> initial_map, StageTimes* times)
    : pace_(pace),
      mapper_(rig, scales, options,
              {[this](std::shared_ptr<const map::Snapshot> snapshot) {
                 const std::lock_guard lock(mutex_);
                 newest_ = std::move(snapshot);
                 deliver(false);
               },
               std::move(callbacks.imu_event)},
              times),
      loops_(loops, options, pace.threaded, pace.live,
             {std::move(callbacks.loop_applied), [this] { queue_.try_push(std::nullopt); }}, times) {
  if (initial_map) {
    mapper_.set_map(map::Map(*initial_map));
    loops_.add_all(*initial_map);
  }
  newest_ = visible_ = mapper_.map().publish();
  if (pace_.threaded) thread_ = std::jthread([this] { run(); });
}

MappingWorker::~MappingWorker() {
  mapper_.cancel();
  queue_.close();
}

void MappingWorker::run() {
  while (const std::optional<Job> job = queue_.pop())
    if (!execute(*job)) return;
}

void MappingWorker::work(const Job& job) {
  loops_.before_keyframe(mapper_);
  if (!job) {
    publish();
    return;
  }
  // Leaving out work because more is waiting would make the map depend on the clock.
  mapper_.process(*job, pace_.live && queue_.size() > 1);
  loops_.after_keyframe(mapper_, job->id);
}

/// False when it failed: `error_` then holds why.
bool MappingWorker::execute(const Job& job) {
  try {
    work(job);
    const std::lock_guard lock(mutex_);
    if (job) {
      ++processed_;
      deliver(true);
    }
    return true;
  } catch (...) {
    {
      const std::lock_guard lock(mutex_);
      error_ = std::current_exception();
    }
    changed_.notify_all();
    queue_.close();
    return false;
  }
}

/// Hands the newest snapshot to the job in progress; the mutex is held.
void MappingWorker::deliver(bool job_done) {
  for (Release& r : releases_) {
    if (r.snapshot) continue;
    if (r.ends_job && !job_done) break;
    r.snapshot = newest_;
    if (r.ends_job || !job_done) break;
  }
  changed_.notify_all();
}

/// Decides when tracking sees the two snapshots of a job; the mutex is held.
void MappingWorker::schedule(std::uint32_t frame, bool needed_at_once) {
  std::uint32_t first = frame + 1;
  if (needed_at_once) {
    for (Release& r : releases_) r.frame = std::min(r.frame, first);
  } else if (!releases_.empty()) {
    first = std::max(first, releases_.back().frame);
  }
  releases_.push_back({first, false, nullptr});
  releases_.push_back({std::max(first, frame + pace_.delay_frames), true, nullptr});
}

void MappingWorker::submit(map::KeyframeRequest request, std::uint32_t frame) {
  const bool starts_map = request.starts_map;
  std::size_t ticket = 0;
  {
    const std::lock_guard lock(mutex_);
    rethrow();
    ticket = ++submitted_;
    if (!pace_.live) schedule(frame, starts_map);
  }
  if (pace_.threaded)
    queue_.push(std::move(request));
  else
    execute(request);
  std::unique_lock lock(mutex_);
  // Live, too, the first keyframe of a map is waited for: without it there is nothing to track
  // against.
  if (pace_.live && starts_map) changed_.wait(lock, [&] { return error_ || processed_ >= ticket; });
  rethrow();
}

MappingWorker::View MappingWorker::view(std::uint32_t frame) {
  std::unique_lock lock(mutex_);
  if (pace_.live) {
    rethrow();
    return {newest_, submitted_ == processed_};
  }
  while (!releases_.empty() && releases_.front().frame <= frame) {
    changed_.wait(lock, [&] { return error_ || releases_.front().snapshot; });
    rethrow();
    visible_ = std::move(releases_.front().snapshot);
    releases_.pop_front();
  }
  return {visible_, releases_.empty()};
}

void MappingWorker::finish() {
  if (pace_.threaded && thread_.joinable()) {
    queue_.close();
    thread_.join();
  }
  {
    const std::lock_guard lock(mutex_);
    rethrow();
  }
  loops_.finish(mapper_);
  publish();
}

void MappingWorker::publish() {
  auto snapshot = mapper_.map().publish();
  const std::lock_guard lock(mutex_);
  newest_ = std::move(snapshot);
}

std::shared_ptr<const map::Snapshot> MappingWorker::snapshot() const {
  const std::lock_guard lock(mutex_);
  return newest_;
}

/// The mutex is held.
void MappingWorker::rethrow() const {
  if (error_) std::rethrow_exception(error_);
}

}  // namespace fastloop::system
