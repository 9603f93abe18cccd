#pragma once

#include <map>
#include <optional>

#include "fastloop/loop/backend.hpp"
#include "fastloop/loop/detection.hpp"
#include "fastloop/loop/loop_correction.hpp"

namespace fastloop::loop {

/// Loop closing as one object: feed it every keyframe with a snapshot that contains it, take
/// corrections. Knows nothing of tracking or mapping.
///
///   LoopCloser closer(options, Backend::kAuto, place::default_vocabulary());
///   auto outcome = closer.process(*map.publish(), keyframe);
///   if (outcome.correction) closer.conclude(map::apply_correction(map, *outcome.correction));
///
/// Threads  `process` and `conclude` from one thread at a time; `database` may be asked by others.
class LoopCloser {
 public:
  /// @param vocabulary  must outlive the closer
  LoopCloser(const LoopOptions& options, Backend backend, const place::Vocabulary& vocabulary);
  /// With executors of one's own, a device session that is shared with nobody say.
  LoopCloser(const LoopOptions& options, Backend backend, const StepExecutors& executors,
             const place::Vocabulary& vocabulary);

  struct Outcome {
    LoopReport report;
    std::optional<map::LoopCorrection> correction;
    /// What was waiting before this keyframe: with it and the snapshot the decision can be replayed.
    LoopDetector::Waiting waiting_before;
  };

  /// Takes a keyframe in without looking for loops.
  void add(const map::Snapshot& snapshot, KeyframeId keyframe);
  /// The same for all keyframes of a map, on all cores unless the back end is the reference.
  void add_all(const map::Snapshot& snapshot);
  /// Takes a keyframe out again, with all that was learnt from processing keyframes: as if none had
  /// been processed.
  void forget(KeyframeId keyframe);
  /// Takes a keyframe in and looks whether it closes a loop.
  Outcome process(const map::Snapshot& snapshot, KeyframeId keyframe);
  /// Tells what became of a correction.
  void conclude(const map::CorrectionOutcome& outcome);

  const place::PlaceDatabase& database() const { return database_; }
  const LoopOptions& options() const { return options_; }
  Backend backend() const { return backend_; }
  const StepExecutors& executors() const { return executors_; }
  void set_waiting(const LoopDetector::Waiting& waiting) { detector_.set_waiting(waiting); }

 private:
  void forget_removed(const map::Snapshot& snapshot, KeyframeId newest);

  LoopOptions options_;
  Backend backend_;
  StepExecutors executors_;
  place::PlaceDatabase database_;
  LoopDetector detector_;
  CorrectionMemory memory_;
  std::map<KeyframeId, KeyframeId> removed_;  ///< keyframes to forget, and the newest one back then
};

}  // namespace fastloop::loop
