#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>

#include "fastloop/core/bounded_queue.hpp"
#include "fastloop/mapping/mapper.hpp"
#include "fastloop/system/loop_closing.hpp"

namespace fastloop::system {

/// How mapping runs beside tracking, and when tracking sees what mapping did.
struct WorkerPace {
  bool threaded = true;  ///< false: `submit` does all the work before it returns
  /// Live operation: tracking sees the newest map. Otherwise the frame count decides and tracking
  /// waits where mapping is behind, so that a run does not depend on the clock.
  bool live = false;
  std::uint32_t delay_frames = 4;  ///< SystemOptions::mapping_delay_frames
};

/// Runs a Mapper, with loop closing beside it, behind a bounded queue in a thread of its own, or in the caller's thread.
///
/// Frame clock (pace.live == false): of a job submitted with frame n, tracking sees the first
/// published snapshot (the keyframe stands in the map) from frame n + 1 on, the last one from frame
/// n + delay_frames on. Jobs become visible in the order they were submitted: the first snapshot of
/// a job waits for the last one of the job before. A job that starts a map is needed by the next
/// frame; whatever came before becomes visible with it.
class MappingWorker {
 public:
  struct Callbacks {
    std::function<void(Nanoseconds, const mapping::ImuStep&)> imu_event;
    std::function<void(const LoopRecord&)> loop_applied;  ///< from the worker's thread
  };
  MappingWorker(const StereoRig& rig, const PyramidScales& scales,
                const mapping::MappingOptions& options, const WorkerPace& pace,
                const LoopClosingOptions& loops, Callbacks callbacks,
                std::shared_ptr<const map::Snapshot> initial_map, StageTimes* times);
  ~MappingWorker();

  /// Hands over what `frame` asks for; waits while the queue is full. Frames never decrease.
  /// Rethrows an exception of the worker.
  void submit(map::KeyframeRequest request, std::uint32_t frame);
  /// Processes what is queued and ends the thread. Rethrows an exception of the worker.
  void finish();

  /// What tracking may know at a frame.
  struct View {
    std::shared_ptr<const map::Snapshot> snapshot;
    bool idle = true;  ///< everything submitted before is in the snapshot
  };
  /// The view of a frame, waiting for mapping if need be. Frames never decrease. Rethrows an
  /// exception of the worker.
  View view(std::uint32_t frame);

  const LoopClosing& loops() const { return loops_; }
  bool full() const { return pace_.threaded && queue_.full(); }
  /// The newest map, whatever the pace; from any thread.
  std::shared_ptr<const map::Snapshot> snapshot() const;

 private:
  /// A snapshot on its way to tracking; empty until mapping has produced it.
  struct Release {
    std::uint32_t frame = 0;  ///< first frame that sees it
    bool ends_job = false;
    std::shared_ptr<const map::Snapshot> snapshot;
  };

  /// A keyframe, or nothing: then there is a correction to apply.
  using Job = std::optional<map::KeyframeRequest>;

  void run();
  bool execute(const Job& job);
  void work(const Job& job);
  void publish();
  void schedule(std::uint32_t frame, bool needed_at_once);
  void deliver(bool job_done);
  void rethrow() const;

  const WorkerPace pace_;
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::shared_ptr<const map::Snapshot> newest_, visible_;
  std::deque<Release> releases_;  ///< two for each job, in the order they become visible
  std::size_t submitted_ = 0, processed_ = 0;
  std::exception_ptr error_;
  BoundedQueue<Job> queue_{3};
  mapping::Mapper mapper_;
  LoopClosing loops_;
  std::jthread thread_;
};

}  // namespace fastloop::system
