#include "fastloop/loop/verification.hpp"

#include <algorithm>

#include "fastloop/loop/correspondences.hpp"
#include "fastloop/loop/keyframe_search.hpp"
#include "fastloop/loop/similarity_ransac.hpp"
#include "fastloop/matching/descriptor_matching.hpp"

namespace fastloop::loop {

using map::LandmarkArrays;
using map::Snapshot;

/// A candidate on its way through the gates.
struct Verifier::Hypothesis {
  Verified* out = nullptr;
  std::vector<KeyframeId> window;
  std::vector<LandmarkPair> pairs;  ///< matched by descriptor, then by projection
  LandmarkArrays cloud;
  SE3 T_camera_world;
  matching::ProjectionMatches found;  ///< of the cloud in the current keyframe

  bool alive() const { return out != nullptr; }
  /// Notes a comparison; the hypothesis ends when it fails.
  bool gate(const char* name, double value, double threshold, bool passed) {
    out->report.gates.push_back({name, value, threshold, passed});
    if (!passed) fail(std::string("too few: ") + name);
    return passed;
  }
  void fail(std::string reason) {
    out->report.reason = std::move(reason);
    out = nullptr;
  }
};

std::vector<KeyframeId> window_of(const Snapshot& snapshot, KeyframeId keyframe,
                                  std::size_t covisibles) {
  std::vector<KeyframeId> window{keyframe};
  for (const KeyframeId id : snapshot.best_covisible(keyframe, covisibles)) window.push_back(id);
  return window;
}

matching::ProjectionMatches Verifier::search(const Snapshot& snapshot, KeyframeId target,
                                             const SE3& T_camera_world,
                                             const LandmarkArrays& cloud, float radius_px,
                                             int max_distance) const {
  const MovedKeyframe one{target, T_camera_world};
  return std::move(
      search_keyframes(executors_, snapshot, {&one, 1}, cloud, radius_px, max_distance).front());
}

void Verifier::match_windows(const Snapshot& snapshot, KeyframeId current,
                             const place::PlaceDatabase& database,
                             std::span<Hypothesis> hypotheses) const {
  struct Job {
    std::size_t hypothesis;
    KeyframeId keyframe;
    std::vector<std::int32_t> matches;
  };
  std::vector<Job> jobs;
  for (std::size_t h = 0; h < hypotheses.size(); ++h)
    if (hypotheses[h].alive())
      for (const KeyframeId id : hypotheses[h].window) jobs.push_back({h, id, {}});

  const place::PlaceDatabase::Words words = database.words(current);
  const std::vector<std::uint8_t> blocked = keypoints_without_landmark(snapshot, current);
  const matching::MatchSide query{snapshot.keyframe(current).data->features.get(),
                                  words ? &words->groups : nullptr, blocked};
  matching::DescriptorMatchOptions rule;
  rule.max_distance = options_.max_match_distance;
  rule.best_to_second = options_.match_ratio;
  executors_.host().for_ranges(jobs.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin) {
      Job& job = jobs[begin];
      const place::PlaceDatabase::Words other = database.words(job.keyframe);
      const std::vector<std::uint8_t> mask = keypoints_without_landmark(snapshot, job.keyframe);
      job.matches = matching::match_descriptors(
          executors_.host(), query,
          {snapshot.keyframe(job.keyframe).data->features.get(), other ? &other->groups : nullptr,
           mask},
          rule);
    }
  });
  for (std::size_t j = 0; j < jobs.size();) {
    Hypothesis& h = hypotheses[jobs[j].hypothesis];
    PairCollector collector(snapshot, current);
    for (const std::size_t of = jobs[j].hypothesis; j < jobs.size() && jobs[j].hypothesis == of; ++j)
      collector.add(jobs[j].keyframe, jobs[j].matches);
    h.pairs = collector.take();
    const int n = static_cast<int>(h.pairs.size());
    h.gate("descriptor matches", n, options_.min_matches, n >= options_.min_matches);
  }
}

void Verifier::solve_similarities(const Snapshot& snapshot, KeyframeId current,
                                  std::span<Hypothesis> hypotheses) const {
  std::vector<SimilarityPairs> problems(hypotheses.size());
  std::vector<RansacResult> results(hypotheses.size());
  for (std::size_t h = 0; h < hypotheses.size(); ++h)
    if (hypotheses[h].alive())
      problems[h] = make_similarity_pairs(snapshot, current, hypotheses[h].window.front(),
                                          hypotheses[h].pairs, options_.ransac_gate_chi2);
  RansacOptions o;
  o.min_inliers = options_.min_ransac_inliers;
  o.seed = current.value();
  find_similarities(executors_, matching::make_camera_view(snapshot.rig().left), problems, o,
                    results);
  for (std::size_t h = 0; h < hypotheses.size(); ++h) {
    if (!hypotheses[h].alive()) continue;
    const RansacResult& r = results[h];
    if (!hypotheses[h].gate("geometric inliers", r.num_inliers, o.min_inliers + 1, r.found)) continue;
    // The second side's frame is the world moved to the candidate's camera.
    const Vector3d origin = snapshot.T_world_camera(hypotheses[h].window.front()).translation;
    hypotheses[h].T_camera_world =
        r.S_first_second.rigid() * SE3(Eigen::Quaterniond::Identity(), Vector3d(-origin));
  }
}

bool Verifier::refine(const Snapshot& snapshot, KeyframeId current, Hypothesis& h,
                      int min_inliers) const {
  const std::vector<optimization::SimilarityPair> pairs =
      make_refinement_pairs(snapshot, current, h.window, h.cloud, h.found);
  const bool published = executors_.reference();
  const optimization::SimilarityResult refined =
      (published ? optimization::refine_similarity_reference : optimization::refine_similarity)(
          snapshot.rig().left, Sim3(h.T_camera_world), pairs, {});
  if (!h.gate("refined inliers", refined.num_inliers, min_inliers,
              refined.num_inliers >= min_inliers))
    return false;
  h.T_camera_world = refined.S_first_second.rigid();
  return true;
}

void Verifier::guide(const Snapshot& snapshot, KeyframeId current, Hypothesis& h) const {
  const LoopOptions& o = options_;
  h.cloud = LandmarkArrays(snapshot, map::landmarks_of(snapshot, h.window), executors_.host());
  h.found = search(snapshot, current, h.T_camera_world, h.cloud, o.wide_radius_px,
                   o.wide_max_distance);
  if (!h.gate("wide projection matches", h.found.count, o.min_wide_matches,
              h.found.count >= o.min_wide_matches))
    return;
  if (!refine(snapshot, current, h, o.min_refined_inliers)) return;
  h.found = search(snapshot, current, h.T_camera_world, h.cloud, o.narrow_radius_px,
                   o.narrow_max_distance);
  h.gate("narrow projection matches", h.found.count, o.min_narrow_matches,
         h.found.count >= o.min_narrow_matches);
}

void Verifier::confirm(const Snapshot& snapshot, KeyframeId current, Hypothesis& h) const {
  const LoopOptions& o = options_;
  const SE3 T_world_current = snapshot.T_world_camera(current);
  const std::vector<KeyframeId> others =
      snapshot.best_covisible(current, o.window_covisibles, o.min_connection);
  // As many keyframes at a time as confirmations are missing: they are searched in one go.
  int agreed = 0;
  for (std::size_t next = 0; next < others.size() && agreed < o.confirmations;) {
    const std::size_t n = std::min(others.size() - next,
                                   static_cast<std::size_t>(o.confirmations - agreed));
    std::vector<MovedKeyframe> moved;
    for (std::size_t i = next; i < next + n; ++i)
      moved.push_back({others[i], snapshot.T_world_camera(others[i]).inverse() * T_world_current *
                                      h.T_camera_world});
    const auto found = search_keyframes(executors_, snapshot, moved, h.cloud, o.covisible_radius_px,
                                        o.covisible_max_distance);
    for (const auto& f : found) agreed += f.count >= o.min_covisible_matches;
    next += n;
  }
  h.out->confirmations = agreed;
  if (!h.gate("confirming covisible keyframes", agreed, 1, agreed >= 1)) return;
}

void Verifier::verify(const Snapshot& snapshot, KeyframeId current,
                      const place::PlaceDatabase& database, std::span<Verified> verified,
                      StageClock& clock) const {
  std::vector<Hypothesis> hypotheses(verified.size());
  const auto is_connected = [&](KeyframeId id) {
    return id == current || snapshot.num_shared(current, id) >= options_.min_connection;
  };
  for (std::size_t h = 0; h < verified.size(); ++h) {
    Hypothesis& x = hypotheses[h];
    x.out = &verified[h];
    x.window = window_of(snapshot, verified[h].report.keyframe, options_.window_covisibles);
    if (std::any_of(x.window.begin(), x.window.end(), is_connected))
      x.fail("the candidate's surroundings are connected to the keyframe already");
  }
  match_windows(snapshot, current, database, hypotheses);
  clock.lap("descriptor_matching");
  solve_similarities(snapshot, current, hypotheses);
  clock.lap("similarity");
  executors_.host().for_ranges(hypotheses.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin) {
      Hypothesis& h = hypotheses[begin];
      if (h.alive()) guide(snapshot, current, h);
      if (h.alive()) h.out->match = make_region_match(snapshot, current, h.window.front(),
                                                      h.T_camera_world, h.cloud, h.found);
      if (h.alive()) confirm(snapshot, current, h);
    }
  });
  clock.lap("projection_searches");
}

Verified Verifier::recheck(const Snapshot& snapshot, KeyframeId current, KeyframeId matched,
                           const SE3& predicted_T_camera_world, StageClock& clock) const {
  const LoopOptions& o = options_;
  Verified verified;
  verified.report.keyframe = matched;
  verified.report.recheck = true;
  Hypothesis h;
  h.out = &verified;
  h.window = window_of(snapshot, matched, o.window_covisibles);
  if (h.window.size() < o.window_covisibles) {
    // A short window is extended by the neighbours of its members.
    const std::vector<KeyframeId> direct = h.window;
    for (const KeyframeId id : direct)
      for (const KeyframeId second : snapshot.best_covisible(id, o.window_covisibles))
        if (std::find(h.window.begin(), h.window.end(), second) == h.window.end())
          h.window.push_back(second);
  }
  h.T_camera_world = predicted_T_camera_world;
  h.cloud = LandmarkArrays(snapshot, map::landmarks_of(snapshot, h.window), executors_.host());
  h.found = search(snapshot, current, h.T_camera_world, h.cloud, o.covisible_radius_px,
                   o.covisible_max_distance);
  if (h.gate("projection matches", h.found.count, o.min_covisible_matches,
             h.found.count >= o.min_covisible_matches) &&
      refine(snapshot, current, h, o.min_recheck_inliers + 1)) {
    h.found = search(snapshot, current, h.T_camera_world, h.cloud, o.covisible_radius_px,
                     o.covisible_max_distance);
    if (h.gate("projection matches after refinement", h.found.count, o.min_recheck_matches,
               h.found.count >= o.min_recheck_matches)) {
      verified.confirmations = 1;
      verified.match =
          make_region_match(snapshot, current, matched, h.T_camera_world, h.cloud, h.found);
    }
  }
  clock.lap("recheck");
  return verified;
}

}  // namespace fastloop::loop
