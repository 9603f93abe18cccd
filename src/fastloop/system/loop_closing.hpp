#pragma once

#include <condition_variable>
#include <deque>
#include <exception>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>

#include "fastloop/core/timing.hpp"
#include "fastloop/loop/loop_closer.hpp"
#include "fastloop/mapping/mapper.hpp"
#include "fastloop/system/background_adjustment.hpp"

namespace fastloop::system {

struct LoopClosingOptions {
  bool enabled = true;      ///< false: keyframes are only made known for relocalisation
  loop::Backend backend = loop::Backend::kAuto;
  loop::LoopOptions loop;
  bool adjust_globally = true;               ///< global bundle adjustment after a loop
  std::size_t max_adjusted_keyframes = 1000; ///< of a map; larger ones are left to the pose graph
  /// Playback: the result of a global adjustment is taken in this many keyframes after its start.
  std::size_t adjustment_delay_keyframes = 10;
  std::filesystem::path record_folder;  ///< the map just before each loop is written there; empty: no
  void validate() const;                ///< throws InvalidArgument naming the field
};

/// A keyframe at which there was something to decide, and what became of it.
struct LoopRecord {
  loop::LoopReport report;
  std::optional<map::CorrectionOutcome> correction;  ///< when a loop was accepted
  loop::Backend backend = loop::Backend::kAuto;
  bool merge = false;
};

/// Keyframes that look most like an image, best first, among those that every run knows at this
/// version of the map: all but the newest, which loop closing may still be looking at.
std::vector<KeyframeId> similar_keyframes(const place::PlaceDatabase& database,
                                          const FeatureSet& features,
                                          const map::Snapshot& snapshot);

/// Loop closing beside mapping: a thread of its own finds loops, the owner of the map applies them
/// between two keyframes, a global adjustment refines the result in the background.
///
/// In playback the owner waits, before it takes in the next keyframe, until the last one has been
/// looked at, so that results do not depend on the clock; live it takes what is ready.
///
/// Threads  The owner of the map calls everything but `records` and `database`.
class LoopClosing {
 public:
  struct Callbacks {
    std::function<void(const LoopRecord&)> applied;  ///< a loop was closed or refused by the map
    std::function<void()> ready;  ///< live: something is waiting to be applied; from any thread
  };
  LoopClosing(const LoopClosingOptions& options, const mapping::MappingOptions& mapping,
              bool threaded, bool live, Callbacks callbacks, StageTimes* times);
  ~LoopClosing();

  /// Makes the keyframes of a map known; to be called before the first keyframe.
  void add_all(const map::Snapshot& snapshot) { closer_.add_all(snapshot); }
  /// Applies what has been found. Rethrows an exception of the threads.
  void before_keyframe(mapping::Mapper& mapper);
  /// Hands over a keyframe that was mapped.
  void after_keyframe(mapping::Mapper& mapper, KeyframeId keyframe);
  /// Waits for everything and applies it.
  void finish(mapping::Mapper& mapper);

  const place::PlaceDatabase& database() const { return closer_.database(); }
  std::vector<LoopRecord> records() const;  ///< in order; any thread

 private:
  struct Job {
    std::shared_ptr<const map::Snapshot> snapshot;
    KeyframeId keyframe;
  };
  struct Found {
    LoopRecord record;
    map::LoopCorrection correction;
  };
  void run();
  void look(const Job& job);
  void record_map(const Job& job, const loop::LoopCloser::Outcome& outcome) const;
  void keep(LoopRecord record);
  void apply_found(mapping::Mapper& mapper, bool wait);
  void apply_adjustment(mapping::Mapper& mapper);
  void start_adjustment(mapping::Mapper& mapper, MapId map);

  const LoopClosingOptions options_;
  const bool threaded_, live_;
  Callbacks callbacks_;
  StageTimes* times_;
  loop::LoopCloser closer_;
  BackgroundAdjustment adjustment_;
  std::size_t keyframes_since_adjustment_ = 0;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<Job> jobs_;
  std::optional<Found> found_;
  bool busy_ = false, closed_ = false;
  std::uint64_t frame_version_ = 0;  ///< older snapshots are not looked at any more
  std::exception_ptr error_;
  std::vector<LoopRecord> records_;
  std::jthread thread_;
};

}  // namespace fastloop::system
