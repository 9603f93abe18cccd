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
  std::shared_ptr<const LandmarkArrays> cloud;
  std::shared_ptr<const matching::ResidentLandmarks> resident;  ///< the cloud on the device
  SE3 T_camera_world;
  std::vector<matching::KeypointMatch> found;  ///< of the cloud in the current keyframe, by landmark

  bool alive() const { return out != nullptr; }
  int count() const { return static_cast<int>(found.size()); }
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

void Verifier::search(const Snapshot& snapshot, KeyframeId current,
                      std::span<Hypothesis> hypotheses, float radius_px, int max_distance) const {
  std::vector<Hypothesis*> alive;
  for (Hypothesis& h : hypotheses)
    if (h.alive()) alive.push_back(&h);
  std::vector<MovedKeyframe> moved;
  for (const Hypothesis* h : alive) moved.push_back({current, h->T_camera_world});
  std::vector<PlaceSearch> places;
  for (std::size_t i = 0; i < alive.size(); ++i)
    places.push_back({alive[i]->cloud.get(), {&moved[i], 1}, &alive[i]->resident});
  const matching::MatchLists found =
      find_in_keyframes(executors_, snapshot, places, radius_px, max_distance);
  for (std::size_t i = 0; i < alive.size(); ++i) {
    alive[i]->found.assign(found[i].begin(), found[i].end());
    std::sort(alive[i]->found.begin(), alive[i]->found.end(),
              [](const auto& a, const auto& b) { return a.landmark < b.landmark; });
  }
}

void Verifier::match_windows(const Snapshot& snapshot, KeyframeId current,
                             const place::PlaceDatabase& database,
                             std::span<Hypothesis> hypotheses) const {
  // Windows of candidates that lie side by side overlap: each keyframe is matched once. The
  // published method matches it for every candidate.
  std::vector<KeyframeId> images;
  for (const Hypothesis& h : hypotheses)
    if (h.alive()) images.insert(images.end(), h.window.begin(), h.window.end());
  if (!executors_.reference()) {
    std::sort(images.begin(), images.end());
    images.erase(std::unique(images.begin(), images.end()), images.end());
  }
  const place::PlaceDatabase::Words words = database.words(current);
  const std::vector<std::uint8_t> blocked = keypoints_without_landmark(snapshot, current);
  const matching::MatchSide query{snapshot.keyframe(current).data->features.get(),
                                  words ? &words->groups : nullptr, blocked};
  matching::DescriptorMatchOptions rule;
  rule.max_distance = options_.max_match_distance;
  rule.best_to_second = options_.match_ratio;
  std::vector<std::vector<std::uint8_t>> masks(images.size());
  std::vector<place::PlaceDatabase::Words> groups(images.size());
  std::vector<matching::MatchSide> sides(images.size());
  executors_.host().for_ranges(images.size(), 4, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      masks[i] = keypoints_without_landmark(snapshot, images[i]);
      groups[i] = database.words(images[i]);
      sides[i] = {snapshot.keyframe(images[i]).data->features.get(),
                  groups[i] ? &groups[i]->groups : nullptr, masks[i]};
    }
  });
  const auto work = static_cast<double>(query.features->size() * images.size());
  const auto matches = matching::match_descriptors(executors_.of(Step::kDescriptors, work), query,
                                                   sides, rule);
  std::size_t next = 0;  // image of the reference
  for (Hypothesis& h : hypotheses) {
    if (!h.alive()) continue;
    PairCollector collector(snapshot, current);
    for (const KeyframeId id : h.window) {
      const std::size_t at =
          executors_.reference()
              ? next++
              : static_cast<std::size_t>(std::lower_bound(images.begin(), images.end(), id) -
                                         images.begin());
      collector.add(id, matches[at]);
    }
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
      make_refinement_pairs(snapshot, current, h.window, *h.cloud, h.found);
  const Camera& camera = snapshot.rig().left;
  const Sim3 initial(h.T_camera_world);
  const optimization::SimilarityResult refined =
      executors_.reference()
          ? optimization::refine_similarity_reference(camera, initial, pairs)
          : optimization::refine_similarity(camera, initial, pairs, {},
                                            executors_.host().for_short_passes());
  if (!h.gate("refined inliers", refined.num_inliers, min_inliers,
              refined.num_inliers >= min_inliers))
    return false;
  h.T_camera_world = refined.S_first_second.rigid();
  return true;
}

/// Goes through [PS2a], refinement and [PS2b] with all candidates side by side.
void Verifier::guide(const Snapshot& snapshot, KeyframeId current,
                     std::span<Hypothesis> hypotheses) const {
  const LoopOptions& o = options_;
  executors_.host().for_ranges(hypotheses.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin)
      if (Hypothesis& h = hypotheses[begin]; h.alive())
        h.cloud = std::make_shared<LandmarkArrays>(
            snapshot, map::landmarks_of(snapshot, h.window), executors_.host());
  });
  search(snapshot, current, hypotheses, o.wide_radius_px, o.wide_max_distance);
  executors_.host().for_ranges(hypotheses.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin)
      if (Hypothesis& h = hypotheses[begin];
          h.alive() && h.gate("wide projection matches", h.count(), o.min_wide_matches,
                              h.count() >= o.min_wide_matches))
        refine(snapshot, current, h, o.min_refined_inliers);
  });
  search(snapshot, current, hypotheses, o.narrow_radius_px, o.narrow_max_distance);
  for (Hypothesis& h : hypotheses)
    if (h.alive() && h.gate("narrow projection matches", h.count(), o.min_narrow_matches,
                            h.count() >= o.min_narrow_matches)) {
      h.out->match = make_region_match(snapshot, current, h.window.front(), h.T_camera_world,
                                       *h.cloud, h.found);
      h.out->match.cloud = h.cloud;
      h.out->match.resident = h.resident;
    }
}

void Verifier::confirm(const Snapshot& snapshot, KeyframeId current,
                       std::span<Hypothesis> hypotheses) const {
  const LoopOptions& o = options_;
  const SE3 T_world_current = snapshot.T_world_camera(current);
  const std::vector<KeyframeId> others =
      snapshot.best_covisible(current, o.window_covisibles, o.min_connection);
  struct Progress {
    Hypothesis* of;
    std::size_t next = 0;  ///< in `others`
    int agreed = 0;
    std::vector<MovedKeyframe> moved;
  };
  std::vector<Progress> all;
  for (Hypothesis& h : hypotheses)
    if (h.alive()) all.push_back({&h, 0, 0, {}});
  // As many keyframes at a time as confirmations are missing: they are searched in one go.
  for (bool searched = true; searched;) {
    std::vector<PlaceSearch> places;
    for (Progress& p : all) {
      const std::size_t n =
          p.agreed < o.confirmations
              ? std::min(others.size() - p.next, static_cast<std::size_t>(o.confirmations - p.agreed))
              : 0;
      p.moved.clear();
      for (std::size_t i = p.next; i < p.next + n; ++i)
        p.moved.push_back({others[i], snapshot.T_world_camera(others[i]).inverse() *
                                          T_world_current * p.of->T_camera_world});
      p.next += n;
      if (n > 0) places.push_back({p.of->cloud.get(), p.moved, &p.of->resident});
    }
    searched = !places.empty();
    if (!searched) break;
    const matching::MatchLists found = find_in_keyframes(
        executors_, snapshot, places, o.covisible_radius_px, o.covisible_max_distance);
    std::size_t list = 0;
    for (Progress& p : all)
      for (std::size_t i = 0; i < p.moved.size(); ++i)
        p.agreed += static_cast<int>(found[list++].size()) >= o.min_covisible_matches;
  }
  for (const Progress& p : all) {
    p.of->out->confirmations = p.agreed;
    p.of->gate("confirming covisible keyframes", p.agreed, 1, p.agreed >= 1);
  }
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
  guide(snapshot, current, hypotheses);
  confirm(snapshot, current, hypotheses);
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
  h.cloud = std::make_shared<LandmarkArrays>(snapshot, map::landmarks_of(snapshot, h.window),
                                             executors_.host());
  search(snapshot, current, {&h, 1}, o.covisible_radius_px, o.covisible_max_distance);
  if (h.gate("projection matches", h.count(), o.min_covisible_matches,
             h.count() >= o.min_covisible_matches) &&
      refine(snapshot, current, h, o.min_recheck_inliers + 1)) {
    search(snapshot, current, {&h, 1}, o.covisible_radius_px, o.covisible_max_distance);
    if (h.gate("projection matches after refinement", h.count(), o.min_recheck_matches,
               h.count() >= o.min_recheck_matches)) {
      verified.confirmations = 1;
      verified.match =
          make_region_match(snapshot, current, matched, h.T_camera_world, *h.cloud, h.found);
    }
  }
  clock.lap("recheck");
  return verified;
}

}  // namespace fastloop::loop
