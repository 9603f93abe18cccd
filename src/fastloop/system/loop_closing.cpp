#include "fastloop/system/loop_closing.hpp"

#include "fastloop/core/error.hpp"
#include "fastloop/core/logging.hpp"
#include "fastloop/core/thread_priority.hpp"
#include "fastloop/loop/loop_request.hpp"
#include "fastloop/map/map_file.hpp"
#include "fastloop/place/default_vocabulary.hpp"

namespace fastloop::system {
namespace {

/// Keyframes that may wait to be looked at; beyond that the oldest are only made known.
constexpr std::size_t kMaxWaiting = 8;
constexpr std::size_t kMaxSimilar = 8;  ///< keyframes proposed for relocalisation

}  // namespace

void LoopClosingOptions::validate() const {
  if (max_adjusted_keyframes < 2)
    throw InvalidArgument("LoopClosingOptions::max_adjusted_keyframes must be at least 2");
  loop.validate();
}

std::vector<KeyframeId> similar_keyframes(const place::PlaceDatabase& database,
                                          const FeatureSet& features,
                                          const map::Snapshot& snapshot) {
  const auto slots = static_cast<std::uint32_t>(snapshot.keyframe_slots());
  std::vector<KeyframeId> excluded;
  for (const KeyframeId id : database.keyframes())
    if (!snapshot.contains(id) || id.value() + 1 >= slots) excluded.push_back(id);
  const auto words = database.words_of(features.descriptors);
  const auto neighbours = [&](KeyframeId id) { return snapshot.best_covisible(id, 10); };
  std::vector<KeyframeId> ids;
  for (const place::PlaceCandidate& c :
       database.query(words->vector, excluded, neighbours, place::QueryOptions{0.5f}))
    ids.push_back(c.keyframe);
  if (ids.size() > kMaxSimilar) ids.resize(kMaxSimilar);
  return ids;
}

LoopClosing::LoopClosing(const LoopClosingOptions& options, const mapping::MappingOptions& mapping,
                         bool threaded, bool live, Callbacks callbacks, StageTimes* times)
    : options_(options),
      threaded_(threaded),
      live_(live),
      callbacks_(std::move(callbacks)),
      times_(times),
      closer_(options.loop, options.backend, place::default_vocabulary()),
      adjustment_(mapping, threaded) {
  if (threaded_) thread_ = std::jthread([this] { run(); });
}

LoopClosing::~LoopClosing() {
  {
    const std::lock_guard lock(mutex_);
    closed_ = true;
    jobs_.clear();
    found_.reset();
  }
  changed_.notify_all();
}

void LoopClosing::run() {
  lower_thread_priority();
  std::unique_lock lock(mutex_);
  for (;;) {
    // A correction that waits to be applied makes every snapshot at hand out of date.
    changed_.wait(lock, [&] { return closed_ || (!jobs_.empty() && !found_); });
    if (closed_) return;
    const Job job = std::move(jobs_.front());
    jobs_.pop_front();
    busy_ = true;
    lock.unlock();
    try {
      look(job);
    } catch (...) {
      lock.lock();
      error_ = std::current_exception();
      closed_ = true;
      busy_ = false;
      changed_.notify_all();
      return;
    }
    lock.lock();
    busy_ = false;
    changed_.notify_all();
  }
}

void LoopClosing::look(const Job& job) {
  bool only_add = !options_.enabled;
  {
    const std::lock_guard lock(mutex_);
    only_add |= job.snapshot->frame_version() < frame_version_ || jobs_.size() >= kMaxWaiting;
  }
  if (only_add) {
    closer_.add(*job.snapshot, job.keyframe);
    return;
  }
  const Stopwatch watch;
  loop::LoopCloser::Outcome outcome = closer_.process(*job.snapshot, job.keyframe);
  if (times_) times_->add(outcome.correction ? "loop_close" : "loop_detect", watch.elapsed_ms());
  LoopRecord record;
  record.report = outcome.report;
  record.backend = closer_.backend();
  if (!outcome.correction) {
    if (!record.report.candidates.empty()) keep(std::move(record));
    return;
  }
  if (!options_.record_folder.empty()) record_map(job, outcome);
  record.merge = outcome.correction->kind == map::LoopCorrection::Kind::kMerge;
  {
    const std::lock_guard lock(mutex_);
    found_ = Found{std::move(record), std::move(*outcome.correction)};
  }
  changed_.notify_all();
  if (live_ && callbacks_.ready) callbacks_.ready();
}

void LoopClosing::record_map(const Job& job, const loop::LoopCloser::Outcome& outcome) const {
  const loop::LoopRequest request{job.keyframe, options_.loop.inertial, outcome.waiting_before};
  const std::string name = "loop_" + std::to_string(job.keyframe.value()) + ".flmap";
  map::write_map_file(options_.record_folder / name, *job.snapshot,
                      {{loop::kLoopRequestExtra, loop::to_json(request)}});
}

void LoopClosing::keep(LoopRecord record) {
  const std::lock_guard lock(mutex_);
  records_.push_back(std::move(record));
}

std::vector<LoopRecord> LoopClosing::records() const {
  const std::lock_guard lock(mutex_);
  return records_;
}

void LoopClosing::before_keyframe(mapping::Mapper& mapper) {
  apply_found(mapper, !live_);
  const bool due =
      live_ ? adjustment_.ready()
            : adjustment_.running() &&
                  keyframes_since_adjustment_ >= options_.adjustment_delay_keyframes;
  if (due) apply_adjustment(mapper);
}

void LoopClosing::after_keyframe(mapping::Mapper& mapper, KeyframeId keyframe) {
  ++keyframes_since_adjustment_;
  Job job{mapper.map().publish(), keyframe};
  if (!threaded_) {
    look(job);
    return;
  }
  {
    const std::lock_guard lock(mutex_);
    jobs_.push_back(std::move(job));
  }
  changed_.notify_all();
}

void LoopClosing::finish(mapping::Mapper& mapper) {
  apply_found(mapper, true);
  if (adjustment_.running()) apply_adjustment(mapper);
}

void LoopClosing::apply_found(mapping::Mapper& mapper, bool wait) {
  for (;;) {
    std::optional<Found> found;
    {
      std::unique_lock lock(mutex_);
      if (wait && threaded_)
        changed_.wait(lock, [&] { return found_ || closed_ || (jobs_.empty() && !busy_); });
      if (error_) std::rethrow_exception(std::exchange(error_, nullptr));
      if (!found_) return;
      found = std::move(found_);
    }
    // `found_` stays engaged (moved from) while it is applied, so that the thread holds still.
    const map::CorrectionOutcome outcome = mapper.apply(found->correction);
    closer_.conclude(outcome);
    LoopRecord& record = found->record;
    record.correction = outcome;
    if (!outcome.applied) {
      record.report.verdict = loop::Verdict::kRejected;
      record.report.reason = "correction refused: " + outcome.reason;
      logger("loop").warn("{}", record.report.reason);
    }
    if (callbacks_.applied) callbacks_.applied(record);
    keep(std::move(record));
    if (outcome.applied) start_adjustment(mapper, found->correction.map);
    {
      const std::lock_guard lock(mutex_);
      found_.reset();
      frame_version_ = mapper.map().frame_version();
    }
    changed_.notify_all();
    if (!wait) return;
  }
}

void LoopClosing::start_adjustment(mapping::Mapper& mapper, MapId map) {
  const map::MapInfo& info = mapper.map().map_info(map);
  if (!options_.adjust_globally || info.num_keyframes > options_.max_adjusted_keyframes) return;
  keyframes_since_adjustment_ = 0;
  adjustment_.start(mapper.map().publish(), map, options_.loop.inertial && info.imu_initialized);
}

void LoopClosing::apply_adjustment(mapping::Mapper& mapper) {
  const auto correction = adjustment_.take();
  if (!correction) return;
  const map::CorrectionOutcome outcome = mapper.apply(*correction);
  if (!outcome.applied)
    logger("loop").warn("global adjustment refused: {}", outcome.reason);
}

}  // namespace fastloop::system
