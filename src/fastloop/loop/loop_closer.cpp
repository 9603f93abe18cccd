#include "fastloop/loop/loop_closer.hpp"

namespace fastloop::loop {

LoopCloser::LoopCloser(const LoopOptions& options, Backend backend,
                       const place::Vocabulary& vocabulary)
    : options_(options),
      backend_(resolve(backend)),
      database_(vocabulary),
      detector_(options, executor_of(backend_)) {}

void LoopCloser::forget_removed(const map::Snapshot& snapshot) {
  for (const KeyframeId id : database_.keyframes())
    if (!snapshot.contains(id)) database_.erase(id);
}

void LoopCloser::add(const map::Snapshot& snapshot, KeyframeId keyframe) {
  if (!snapshot.contains(keyframe) || database_.words(keyframe)) return;
  database_.insert(keyframe,
                   database_.words_of(snapshot.keyframe(keyframe).data->features->descriptors));
}

LoopCloser::Outcome LoopCloser::process(const map::Snapshot& snapshot, KeyframeId keyframe) {
  Outcome outcome;
  outcome.waiting_before = detector_.waiting();
  StageClock clock;
  forget_removed(snapshot);
  add(snapshot, keyframe);
  clock.lap("words");
  LoopDetector::Result detected = detector_.detect(snapshot, keyframe, database_);
  outcome.report = std::move(detected.report);
  outcome.report.times_ms.insert(outcome.report.times_ms.begin(), clock.times_ms().front());
  if (!detected.match) return outcome;
  StageClock correcting;
  outcome.correction = compute_correction(snapshot, *detected.match, options_, backend_, memory_,
                                          correcting);
  for (const auto& time : correcting.times_ms()) outcome.report.times_ms.push_back(time);
  return outcome;
}

void LoopCloser::conclude(const map::CorrectionOutcome& outcome) {
  if (outcome.applied) detector_.forget();
}

}  // namespace fastloop::loop
