#include "fastloop/loop/loop_replay.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/place/default_vocabulary.hpp"

namespace fastloop::loop {
namespace {

double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

LoopOptions with_request(LoopOptions options, const LoopRequest& request) {
  options.inertial = request.inertial;
  return options;
}

/// 64-bit FNV-1a over numbers.
class Digest {
 public:
  void add(std::int64_t value) {
    for (int byte = 0; byte < 8; ++byte) {
      hash_ ^= static_cast<std::uint64_t>(value >> (8 * byte)) & 0xff;
      hash_ *= 1099511628211u;
    }
  }
  void add(const std::string& text) {
    for (const char c : text) add(c);
    add(-1);
  }
  template <class Tag>
  void add(Id<Tag> id) {
    add(static_cast<std::int64_t>(id.value()));
  }
  std::uint64_t value() const { return hash_; }

 private:
  std::uint64_t hash_ = 14695981039346656037u;
};

/// A gate that counts; the others compare lengths and angles, and name their unit.
bool is_count(const std::string& gate) {
  return !gate.ends_with(" m") && !gate.ends_with(" rad");
}

ReplaySummary summarise(const std::vector<ReplayRun>& runs, Backend backend) {
  ReplaySummary s;
  s.backend = backend;
  s.repeats = static_cast<int>(runs.size());
  const auto over_runs = [&](auto value_of) {
    std::vector<double> values;
    for (const ReplayRun& run : runs) values.push_back(value_of(run));
    return median(std::move(values));
  };
  s.total_ms = over_runs([](const ReplayRun& r) { return r.total_ms; });
  s.total_without_graph_ms = over_runs([](const ReplayRun& r) { return r.total_without_graph_ms; });
  s.landmarks_and_covisibility_ms =
      over_runs([](const ReplayRun& r) { return r.landmarks_and_covisibility_ms(); });
  // The stages are the same in every repetition: the decisions are.
  for (std::size_t i = 0; i < runs.back().stages_ms.size(); ++i)
    s.stages_ms.emplace_back(runs.back().stages_ms[i].first, over_runs([&](const ReplayRun& r) {
                               return r.stages_ms.at(i).second;
                             }));
  s.last = runs.back();
  return s;
}

}  // namespace

double ReplayRun::landmarks_and_covisibility_ms() const {
  double sum = 0;
  for (const auto& [stage, ms] : stages_ms)
    if (stage == "landmarks" || stage == "connections" || stage == "apply_landmarks" ||
        stage == "apply_covisibility")
      sum += ms;
  return sum;
}

LoopReplay::LoopReplay(std::shared_ptr<const map::Snapshot> snapshot, const LoopRequest& request,
                       Backend backend, LoopOptions options)
    : snapshot_(std::move(snapshot)),
      request_(request),
      closer_(std::make_unique<LoopCloser>(with_request(options, request), backend,
                                           place::default_vocabulary())) {
  closer_->add_all(*snapshot_);
}

ReplayRun LoopReplay::run() {
  closer_->forget(request_.keyframe);
  closer_->set_waiting(request_.waiting);
  map::Map map(*snapshot_);
  ReplayRun run;
  const Stopwatch watch;
  run.outcome = closer_->process(*snapshot_, request_.keyframe);
  if (run.outcome.correction)
    run.applied =
        map::apply_correction(map, *run.outcome.correction, {}, closer_->executors().host());
  run.total_ms = watch.elapsed_ms();
  run.stages_ms = run.outcome.report.times_ms;
  double graph_ms = 0;
  for (const auto& [stage, ms] : run.stages_ms) {
    if (stage == "graph_build" || stage == "graph_solve") graph_ms += ms;
    if (stage == "graph_finish") run.total_ms -= ms;
  }
  run.total_without_graph_ms = run.total_ms - graph_ms;
  if (run.outcome.correction) {
    run.stages_ms.emplace_back("apply_check", run.applied.times.check_ms);
    run.stages_ms.emplace_back("apply_poses", run.applied.times.poses_ms);
    run.stages_ms.emplace_back("apply_landmarks", run.applied.times.landmarks_ms);
    run.stages_ms.emplace_back("apply_covisibility", run.applied.times.covisibility_ms);
  }
  return run;
}

std::vector<ReplaySummary> repeat_replays(std::span<LoopReplay> replays, int repeats) {
  if (repeats < 1) throw InvalidArgument("a replay needs at least one repetition");
  std::vector<std::vector<ReplayRun>> runs(replays.size());
  for (LoopReplay& replay : replays) replay.run();
  for (int i = 0; i < repeats; ++i)
    for (std::size_t r = 0; r < replays.size(); ++r) runs[r].push_back(replays[r].run());
  std::vector<ReplaySummary> summaries;
  for (std::size_t r = 0; r < replays.size(); ++r)
    summaries.push_back(summarise(runs[r], replays[r].backend()));
  return summaries;
}

std::uint64_t decision_digest(const LoopCloser::Outcome& outcome) {
  Digest d;
  const LoopReport& report = outcome.report;
  d.add(report.keyframe);
  d.add(static_cast<std::int64_t>(report.verdict));
  for (const CandidateReport& c : report.candidates) {
    d.add(c.keyframe);
    d.add(static_cast<std::int64_t>(c.verdict));
    d.add(c.shared_words);
    d.add(c.descriptor_matches);
    d.add(c.reason);
    for (const GateReading& g : c.gates) {
      d.add(g.gate);
      d.add(g.passed);
      if (is_count(g.gate)) d.add(std::llround(g.value));
    }
  }
  if (!outcome.correction) return d.value();
  const map::LoopCorrection& c = *outcome.correction;
  d.add(static_cast<std::int64_t>(c.kind));
  for (const map::CorrectedState& s : c.states) d.add(s.keyframe);
  for (const map::LandmarkMerge& m : c.merges) {
    d.add(m.loser);
    d.add(m.winner);
  }
  for (const map::NewObservation& o : c.observations) {
    d.add(o.landmark);
    d.add(o.keyframe);
    d.add(o.keypoint);
  }
  return d.value();
}

std::uint64_t pose_digest(const LoopCloser::Outcome& outcome) {
  Digest d;
  if (!outcome.correction) return d.value();
  for (const map::CorrectedState& s : outcome.correction->states) {
    const SE3& T = s.after.T_world_body;
    // A rotation has two quaternions; the one with positive w speaks for it.
    const double sign = T.rotation.w() < 0 ? -1 : 1;
    for (int i = 0; i < 4; ++i) d.add(std::llround(sign * T.rotation.coeffs()[i] * 1e5));
    for (int i = 0; i < 3; ++i) d.add(std::llround(T.translation[i] * 1e5));
  }
  return d.value();
}

double largest_pose_difference(const LoopCloser::Outcome& a, const LoopCloser::Outcome& b) {
  constexpr double kDifferent = std::numeric_limits<double>::infinity();
  if (a.correction.has_value() != b.correction.has_value()) return kDifferent;
  if (!a.correction) return 0;
  const auto &p = a.correction->states, &q = b.correction->states;
  if (p.size() != q.size()) return kDifferent;
  double largest = 0;
  for (std::size_t i = 0; i < p.size(); ++i) {
    if (p[i].keyframe != q[i].keyframe) return kDifferent;
    const SE3 &x = p[i].after.T_world_body, &y = q[i].after.T_world_body;
    largest = std::max({largest, (x.translation - y.translation).norm(), angle_between(x, y)});
  }
  return largest;
}

LoopRequest request_of(const map::LoadedMap& loaded, const std::filesystem::path& file) {
  const auto it = loaded.extras.find(kLoopRequestExtra);
  if (it == loaded.extras.end())
    throw InputError({file.string(), 0, kLoopRequestExtra}, "this map carries no request",
                     "a file of fastloop run --record-loops or fastloop simulate-map");
  LoopRequest request;
  try {
    request = parse_loop_request(it->second);
  } catch (const InvalidArgument& e) {
    throw InputError({file.string(), 0, kLoopRequestExtra}, e.what());
  }
  const auto exists = [&](KeyframeId id) { return id.value() < loaded.map.keyframe_slots(); };
  bool fits = loaded.map.contains(request.keyframe);
  for (const auto& waiting : {request.waiting.loop, request.waiting.merge})
    fits &= !waiting || (exists(waiting->last_keyframe) && exists(waiting->matched));
  if (!fits)
    throw InputError({file.string(), 0, kLoopRequestExtra},
                     "it names a keyframe that the map does not hold");
  return request;
}

}  // namespace fastloop::loop
