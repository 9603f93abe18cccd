#include "fastloop/loop/loop_closer.hpp"

#include "fastloop/compute/worker_team.hpp"

namespace fastloop::loop {

LoopCloser::LoopCloser(const LoopOptions& options, Backend backend,
                       const place::Vocabulary& vocabulary)
    : LoopCloser(options, resolve(backend), executors_of(backend), vocabulary) {}

LoopCloser::LoopCloser(const LoopOptions& options, Backend backend,
                       const StepExecutors& executors, const place::Vocabulary& vocabulary)
    : options_(options),
      backend_(backend),
      executors_(executors),
      database_(vocabulary),
      detector_(options, executors_) {}

namespace {
/// Readers of older snapshots may still ask for a removed keyframe; this many keyframes later none
/// does.
constexpr std::uint32_t kForgetAfter = 20;
}  // namespace

void LoopCloser::forget_removed(const map::Snapshot& snapshot, KeyframeId newest) {
  for (const KeyframeId id : database_.keyframes()) {
    if (snapshot.contains(id)) continue;
    const KeyframeId since = removed_.try_emplace(id, newest).first->second;
    if (newest.value() < since.value() + kForgetAfter) continue;
    database_.erase(id);
    removed_.erase(id);
  }
}

void LoopCloser::add(const map::Snapshot& snapshot, KeyframeId keyframe) {
  if (!snapshot.contains(keyframe) || database_.words(keyframe)) return;
  const auto& features = snapshot.keyframe(keyframe).data->features;
  matching::make_resident(executors_.device(), features);
  database_.insert(keyframe, database_.words_of(features->descriptors, executors_.host()));
}

void LoopCloser::add_all(const map::Snapshot& snapshot) {
  std::vector<KeyframeId> ids;
  for (std::uint32_t i = 0; i < snapshot.keyframe_slots(); ++i)
    if (snapshot.contains(KeyframeId(i)) && !database_.words(KeyframeId(i))) ids.emplace_back(i);
  std::vector<place::PlaceDatabase::Words> words(ids.size());
  executors_.host().for_ranges(ids.size(), 4, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin)
      words[begin] =
          database_.words_of(snapshot.keyframe(ids[begin]).data->features->descriptors);
  });
  for (std::size_t i = 0; i < ids.size(); ++i) {
    matching::make_resident(executors_.device(), snapshot.keyframe(ids[i]).data->features);
    database_.insert(ids[i], std::move(words[i]));
  }
}

void LoopCloser::forget(KeyframeId keyframe) {
  database_.erase(keyframe);
  detector_.forget();
  memory_ = {};
}

LoopCloser::Outcome LoopCloser::process(const map::Snapshot& snapshot, KeyframeId keyframe) {
  std::optional<WorkerTeam::Shift> shift;
  if (!executors_.reference()) shift.emplace();
  Outcome outcome;
  outcome.waiting_before = detector_.waiting();
  StageClock clock;
  forget_removed(snapshot, keyframe);
  add(snapshot, keyframe);
  clock.lap("words");
  LoopDetector::Result detected = detector_.detect(snapshot, keyframe, database_);
  outcome.report = std::move(detected.report);
  outcome.report.times_ms.insert(outcome.report.times_ms.begin(), clock.times_ms().front());
  if (!detected.match) return outcome;
  StageClock correcting;
  outcome.correction = compute_correction(snapshot, *detected.match, options_, executors_, memory_,
                                          correcting);
  for (const auto& time : correcting.times_ms()) outcome.report.times_ms.push_back(time);
  return outcome;
}

void LoopCloser::conclude(const map::CorrectionOutcome& outcome) {
  if (outcome.applied) detector_.forget();
}

}  // namespace fastloop::loop
