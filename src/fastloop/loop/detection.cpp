#include "fastloop/loop/detection.hpp"

#include <algorithm>
#include <unordered_map>

#include "fastloop/loop/correspondences.hpp"
#include "fastloop/loop/gates.hpp"
#include "fastloop/place/candidate_ranking.hpp"

namespace fastloop::loop {

using map::Snapshot;

const char* to_string(Verdict verdict) {
  switch (verdict) {
    case Verdict::kRejected:
      return "rejected";
    case Verdict::kWaiting:
      return "waiting";
    case Verdict::kAccepted:
      return "accepted";
  }
  return "unknown";
}

LoopDetector::LoopDetector(const LoopOptions& options, const StepExecutors& executors)
    : options_(options), executors_(executors), verifier_(options, executors) {
  options_.validate();
}

bool LoopDetector::is_ready(const Snapshot& snapshot, KeyframeId keyframe) const {
  if (!snapshot.contains(keyframe)) return false;
  const map::MapInfo& info = snapshot.map_info(snapshot.keyframe(keyframe).map);
  return info.num_keyframes >= options_.min_keyframes &&
         (!options_.inertial || (info.imu_initialized && info.imu_refinements >= 2));
}

std::vector<place::RankedCandidate> LoopDetector::rank(
    const Snapshot& snapshot, KeyframeId keyframe, const place::PlaceDatabase& database,
    const std::vector<place::PlaceCandidate>& found) const {
  place::RankingOptions ranking;
  ranking.max_candidates = options_.ranked_candidates;
  ranking.matching.max_distance = options_.max_match_distance;
  ranking.matching.best_to_second = options_.match_ratio;
  // What the sides refer to; ready before threads ask for it.
  struct Side {
    std::vector<std::uint8_t> mask;
    place::PlaceDatabase::Words words;
    matching::MatchSide view;
  };
  const auto make_side = [&](KeyframeId id) {
    Side s{keypoints_without_landmark(snapshot, id), database.words(id), {}};
    s.view = {snapshot.keyframe(id).data->features.get(), s.words ? &s.words->groups : nullptr,
              s.mask};
    return s;
  };
  std::unordered_map<KeyframeId, Side> sides;
  const std::size_t looked_at =
      std::min(found.size(), static_cast<std::size_t>(options_.ranked_candidates));
  for (std::size_t i = 0; i < looked_at; ++i)
    sides.try_emplace(found[i].keyframe, make_side(found[i].keyframe));
  const Side self = make_side(keyframe);
  const auto work = static_cast<double>(self.view.features->size() * looked_at);
  return place::rank_by_matches(
      executors_.of(Step::kDescriptors, work), self.view, found,
      [&](KeyframeId id) { return sides.at(id).view; }, ranking);
}

std::vector<Verified> LoopDetector::candidates(const Snapshot& snapshot, KeyframeId keyframe,
                                               const place::PlaceDatabase& database) const {
  const place::PlaceDatabase::Words words = database.words(keyframe);
  if (!words) return {};
  std::vector<KeyframeId> excluded{keyframe};
  for (const map::CovisibilityEdge& e : snapshot.covisible(keyframe))
    excluded.push_back(e.keyframe);
  for (const KeyframeId id : database.keyframes())
    if (!snapshot.contains(id)) excluded.push_back(id);
  place::QueryOptions query;
  query.min_shared_ratio = options_.min_shared_ratio;
  const std::vector<place::PlaceCandidate> all = database.query(
      words->vector, excluded,
      [&](KeyframeId id) {
        return snapshot.contains(id) ? snapshot.best_covisible(id, options_.window_covisibles)
                                     : std::vector<KeyframeId>{};
      },
      query);

  std::vector<Verified> chosen;
  for (const bool merge : {false, true}) {
    if (!(merge ? options_.merge_maps : options_.close_loops)) continue;
    std::vector<place::PlaceCandidate> of_kind;
    for (const place::PlaceCandidate& c : all) {
      if (!snapshot.contains(c.keyframe)) continue;
      const map::MapInfo& info = snapshot.map_info(snapshot.keyframe(c.keyframe).map);
      const bool other = info.id != snapshot.keyframe(keyframe).map;
      if (other == merge && (!other || !options_.inertial || info.imu_initialized))
        of_kind.push_back(c);
    }
    const auto ranked = rank(snapshot, keyframe, database, of_kind);
    for (std::size_t i = 0; i < std::min(options_.candidates, ranked.size()); ++i) {
      Verified v;
      v.report.keyframe = ranked[i].candidate.keyframe;
      v.report.merge = merge;
      v.report.score = ranked[i].candidate.score;
      v.report.shared_words = ranked[i].candidate.shared_words;
      v.report.descriptor_matches = ranked[i].matches;
      chosen.push_back(std::move(v));
    }
  }
  return chosen;
}

bool LoopDetector::recheck(const Snapshot& snapshot, KeyframeId keyframe,
                           std::optional<WaitingRegion>& waiting, StageClock& clock,
                           Result& result) const {
  if (!waiting) return false;
  if (!snapshot.contains(waiting->matched) ||
      waiting->last_keyframe.value() >= snapshot.keyframe_slots()) {
    waiting.reset();
    return false;
  }
  const SE3 T_current_last = snapshot.T_world_camera(keyframe).inverse() *
                             snapshot.T_world_camera(waiting->last_keyframe);
  const SE3 predicted = T_current_last * waiting->T_last_matched *
                        snapshot.T_world_camera(waiting->matched).inverse();
  Verified v = verifier_.recheck(snapshot, keyframe, waiting->matched, predicted, clock);
  v.report.merge = snapshot.keyframe(waiting->matched).map != snapshot.keyframe(keyframe).map;
  if (v.confirmations == 0) {
    if (++waiting->misses >= options_.max_misses) waiting.reset();
    result.report.candidates.push_back(std::move(v.report));
    return false;
  }
  waiting->misses = 0;
  waiting->last_keyframe = keyframe;
  waiting->T_last_matched =
      v.match.T_camera_world * snapshot.T_world_camera(waiting->matched);
  ++waiting->confirmations;
  const bool enough = waiting->confirmations >= options_.confirmations;
  v.report.gates.push_back({"confirmations", static_cast<double>(waiting->confirmations),
                            static_cast<double>(options_.confirmations), enough});
  if (enough) {
    waiting.reset();
    if (is_possible(snapshot, v.match, v.report)) accept(snapshot, v.match, v.report, result);
  } else {
    v.report.verdict = Verdict::kWaiting;
    v.report.reason = "waits for more keyframes that agree";
  }
  result.report.candidates.push_back(std::move(v.report));
  return true;
}

bool LoopDetector::is_possible(const Snapshot& snapshot, RegionMatch& match,
                               CandidateReport& report) const {
  const auto fault = check_motion(snapshot, options_, match, report);
  if (fault) {
    report.verdict = Verdict::kRejected;
    report.reason = *fault;
  }
  return !fault;
}

void LoopDetector::accept(const Snapshot& snapshot, const RegionMatch& match,
                          CandidateReport& report, Result& result) const {
  report.verdict = Verdict::kAccepted;
  const SE3 T_world_body = match.T_camera_world.inverse() * snapshot.rig().T_body_left.inverse();
  report.measured = {snapshot.keyframe(match.matched).data->stamp_ns,
                     snapshot.T_world_body(match.matched).inverse() * T_world_body};
  report.reason = match.merge ? "maps joined" : "loop closed";
  result.match = match;
}

Verified* LoopDetector::best_of(const Snapshot& snapshot, std::span<Verified> verified,
                                bool merge) const {
  std::vector<Verified*> possible;
  for (Verified& v : verified)
    if (v.report.merge == merge && v.confirmations > 0 && is_possible(snapshot, v.match, v.report))
      possible.push_back(&v);
  if (possible.empty()) return nullptr;
  Verified* best = *std::max_element(possible.begin(), possible.end(), [](auto* a, auto* b) {
    return a->match.num_matches < b->match.num_matches;
  });
  const SE3 T_best = best->match.T_camera_world.inverse();
  bool ambiguous = false;
  for (Verified* v : possible) {
    if (v == best ||
        snapshot.keyframe(v->match.matched).map != snapshot.keyframe(best->match.matched).map)
      continue;
    const SE3 T = v->match.T_camera_world.inverse();
    if ((T.translation - T_best.translation).norm() <= options_.ambiguous_distance_m &&
        angle_between(T, T_best) <= options_.ambiguous_angle_rad) {
      v->report.reason = "agrees with a candidate that has more matches";
      continue;
    }
    ambiguous = true;
    v->report.reason = "ambiguous: several places look like this one";
  }
  if (ambiguous) best->report.reason = "ambiguous: several places look like this one";
  return ambiguous ? nullptr : best;
}

void LoopDetector::choose(const Snapshot& snapshot, KeyframeId keyframe,
                          std::span<Verified> verified, bool merge, Result& result) {
  Verified* best = best_of(snapshot, verified, merge);
  if (!best) return;
  if (best->confirmations >= options_.confirmations) {
    accept(snapshot, best->match, best->report, result);
    return;
  }
  best->report.verdict = Verdict::kWaiting;
  best->report.reason = "waits for more keyframes that agree";
  WaitingRegion w;
  w.last_keyframe = keyframe;
  w.matched = best->match.matched;
  w.T_last_matched = best->match.T_camera_world * snapshot.T_world_camera(w.matched);
  w.confirmations = best->confirmations;
  (merge ? waiting_.merge : waiting_.loop) = w;
}

LoopDetector::Result LoopDetector::detect(const Snapshot& snapshot, KeyframeId keyframe,
                                          const place::PlaceDatabase& database) {
  Result result;
  result.report.keyframe = keyframe;
  if (!is_ready(snapshot, keyframe)) {
    result.report.reason = "the map is too small or its IMU not settled";
    return result;
  }
  result.report.stamp_ns = snapshot.keyframe(keyframe).data->stamp_ns;
  StageClock clock;
  const bool loop_again = recheck(snapshot, keyframe, waiting_.loop, clock, result);
  const bool merge_again =
      !result.match && recheck(snapshot, keyframe, waiting_.merge, clock, result);
  if (!result.match && !(loop_again && merge_again)) {
    std::vector<Verified> verified = candidates(snapshot, keyframe, database);
    clock.lap("query");
    if (!verified.empty()) verifier_.verify(snapshot, keyframe, database, verified, clock);
    for (const bool merge : {true, false})
      if (!result.match && !(merge ? merge_again : loop_again))
        choose(snapshot, keyframe, verified, merge, result);
    for (Verified& v : verified) result.report.candidates.push_back(std::move(v.report));
  }
  for (const CandidateReport& c : result.report.candidates)
    if (c.verdict >= result.report.verdict) {
      result.report.verdict = c.verdict;
      result.report.reason = c.reason;
    }
  if (result.report.candidates.empty()) result.report.reason = "no candidate";
  result.report.times_ms = clock.times_ms();
  return result;
}

}  // namespace fastloop::loop
