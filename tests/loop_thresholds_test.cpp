#include "loop_thresholds.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <set>

#include "fastloop/loop/correspondences.hpp"
#include "fastloop/loop/keyframe_search.hpp"

/// Every threshold of loop closing has a test with a value just inside and one just outside, at the
/// smallest function that applies it:
///
///   here:
///     min_matches, min_ransac_inliers, min_wide_matches, min_refined_inliers, min_narrow_matches,
///     min_covisible_matches, min_recheck_inliers, min_recheck_matches, window_covisibles,
///     ransac_gate_chi2 (what it is multiplied with), min_connection (surroundings, correction);
///     that radii, distances and ratio of the options reach their searches
///   loop_detector_thresholds_test:
///     min_keyframes, inertial (settled IMU), close_loops, candidates, ranked_candidates,
///     min_shared_ratio, confirmations, max_misses, ambiguous_distance_m, ambiguous_angle_rad,
///     graph_min_connection, keyframes until a removed one is forgotten, LoopOptions::validate
///   loop_correction_limits_test: CorrectionLimits
///   loop_closing_test: merge_maps
///   loop/keyframe_search_test: wide_, narrow_, covisible_ and fusion_radius_px and -max_distance,
///     octaves, distance range, viewing angle (and matching/projection_gates_test)
///   loop/fusion_test: fusion_radius_px, fusion_max_distance, min_connection (new connections)
///   loop/similarity_ransac_test: min_ransac_inliers, ransac_gate_chi2, number of hypotheses
///   loop/gates_test: max_tilt_rad, max_yaw_rad, max_drift_ratio, max_drift_constant_m,
///     max_drift_rad_per_m, max_drift_constant_rad
///   matching/descriptor_matching_test: max_match_distance, match_ratio
///   optimization/similarity_refinement_test: gate and least number of pairs of the refinement
///   place/inverted_index_test: min_shared_ratio
namespace fastloop::loop {
namespace {

using testing::Thresholds;

struct CountGate {
  const char* name;
  int LoopOptions::*threshold;
};

class Verify : public Thresholds {};

TEST_F(Verify, CountsAtTheirThresholds) {
  ASSERT_EQ(confirmed().confirmations, options_.confirmations) << confirmed().report.reason;
  for (const CountGate& g : {CountGate{"descriptor matches", &LoopOptions::min_matches},
                             {"wide projection matches", &LoopOptions::min_wide_matches},
                             {"refined inliers", &LoopOptions::min_refined_inliers},
                             {"narrow projection matches", &LoopOptions::min_narrow_matches}}) {
    SCOPED_TRACE(g.name);
    const GateReading* seen = gate(confirmed().report, g.name);
    ASSERT_NE(seen, nullptr);
    EXPECT_EQ(seen->threshold, LoopOptions{}.*g.threshold);
    const int n = static_cast<int>(seen->value);
    options_ = {};
    options_.*g.threshold = n;
    EXPECT_GT(verify().confirmations, 0);
    options_.*g.threshold = n + 1;
    const Verified refused = verify();
    EXPECT_EQ(refused.confirmations, 0);
    ASSERT_FALSE(refused.report.gates.empty());
    EXPECT_EQ(refused.report.gates.back().gate, g.name);
    EXPECT_EQ(refused.report.gates.back().value, n);
    EXPECT_FALSE(refused.report.gates.back().passed);
    EXPECT_EQ(refused.report.reason, std::string("too few: ") + g.name);
  }
}

TEST_F(Verify, GeometricInliersAreMoreThanTheThreshold) {
  const GateReading* seen = gate(confirmed().report, "geometric inliers");
  ASSERT_NE(seen, nullptr);
  EXPECT_EQ(seen->threshold, options_.min_ransac_inliers + 1);
  options_.min_ransac_inliers = static_cast<int>(seen->value) - 1;
  EXPECT_GT(verify().confirmations, 0);
  // No hypothesis has more inliers than there are pairs.
  options_.min_ransac_inliers =
      static_cast<int>(gate(confirmed().report, "descriptor matches")->value);
  EXPECT_EQ(verify().report.gates.back().gate, "geometric inliers");
  EXPECT_EQ(verify().confirmations, 0);
}

TEST_F(Verify, MatchesThatMakeACovisibleKeyframeAgree) {
  const map::LandmarkArrays cloud(
      map_, map::landmarks_of(map_, window_of(map_, matched_, options_.window_covisibles)));
  std::vector<int> counts;
  for (const KeyframeId id :
       map_.best_covisible(current_, options_.window_covisibles, options_.min_connection)) {
    const MovedKeyframe one{id, map_.T_world_camera(id).inverse() * map_.T_world_camera(current_) *
                                    confirmed().match.T_camera_world};
    counts.push_back(search_keyframes(Executor::reference(), map_, {&one, 1}, cloud,
                                      options_.covisible_radius_px, options_.covisible_max_distance)
                         .front()
                         .count);
  }
  const int most = *std::max_element(counts.begin(), counts.end());
  options_.confirmations = 100;  // all are looked at
  for (const int min : {most, most + 1, 30}) {
    options_.min_covisible_matches = min;
    const auto agreeing =
        std::count_if(counts.begin(), counts.end(), [&](int n) { return n >= min; });
    const Verified v = verify();
    EXPECT_EQ(v.confirmations, agreeing) << min;
    EXPECT_EQ(v.report.gates.back().gate, "confirming covisible keyframes");
    EXPECT_EQ(v.report.gates.back().passed, agreeing > 0);
  }
}

TEST_F(Verify, RadiiAndDistancesReachTheirSearches) {
  const auto fails_at = [&](const char* name) {
    const Verified v = verify();
    EXPECT_EQ(v.confirmations, 0) << name;
    EXPECT_EQ(v.report.gates.back().gate, name);
    options_ = {};
  };
  options_.max_match_distance = 1;
  fails_at("descriptor matches");
  options_.match_ratio = 0.01f;  // keypoints that are alone in their group need no ratio
  EXPECT_LT(verify().report.gates.front().value, confirmed().report.gates.front().value);
  options_ = {};
  options_.ransac_gate_chi2 = 1e-6;
  fails_at("geometric inliers");
  options_.wide_radius_px = 0.01f;
  fails_at("wide projection matches");
  options_.wide_max_distance = 3;
  fails_at("wide projection matches");
  options_.narrow_radius_px = 0.01f;
  fails_at("narrow projection matches");
  options_.narrow_max_distance = 3;
  fails_at("narrow projection matches");
  options_.covisible_radius_px = 0.01f;
  fails_at("confirming covisible keyframes");
  options_.covisible_max_distance = 3;
  fails_at("confirming covisible keyframes");
  EXPECT_GT(verify().confirmations, 0);
}

TEST_F(Verify, ConnectedSurroundings) {
  const std::string reason = "the candidate's surroundings are connected to the keyframe already";
  options_.window_covisibles = 0;
  for (const map::CovisibilityEdge& e : map_.covisible(current_)) {
    options_.min_connection = e.shared;
    EXPECT_EQ(verify(e.keyframe).report.reason, reason);
    options_.min_connection = e.shared + 1;
    EXPECT_NE(verify(e.keyframe).report.reason, reason);
  }
  EXPECT_FALSE(map_.covisible(current_).empty());
  EXPECT_EQ(verify(current_).report.reason, reason);
}

TEST_F(Thresholds, Window) {
  std::vector<map::CovisibilityEdge> all = map_.covisible(matched_);
  std::stable_sort(all.begin(), all.end(),
                   [](const auto& a, const auto& b) { return a.shared > b.shared; });
  ASSERT_GT(all.size(), 10u);
  for (const std::size_t n :
       {std::size_t{0}, std::size_t{1}, std::size_t{10}, all.size(), all.size() + 1}) {
    std::vector<KeyframeId> expected{matched_};
    for (std::size_t i = 0; i < std::min(n, all.size()); ++i) expected.push_back(all[i].keyframe);
    EXPECT_EQ(window_of(map_, matched_, n), expected);
  }
}

TEST_F(Thresholds, RansacGate) {
  const auto found = confirmed().match.landmarks;
  std::vector<LandmarkPair> pairs;
  for (std::uint32_t i = 0; i < found.size(); ++i)
    if (found[i].valid() && map_.keyframe(current_).landmarks[i].valid()) {
      const map::Observation& o = map_.landmark(found[i]).observations.front();
      pairs.push_back({i, found[i], o.keyframe, o.keypoint});
    }
  ASSERT_GT(pairs.size(), 20u);
  const SimilarityPairs problem =
      make_similarity_pairs(map_, current_, matched_, pairs, options_.ransac_gate_chi2);
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const auto octave = [&](KeyframeId id, std::uint32_t keypoint) {
      return map_.keyframe(id).data->features->octave[keypoint];
    };
    EXPECT_FLOAT_EQ(problem.gate_first[i],
                    9.21f * map_.scales().sigma2[octave(current_, pairs[i].keypoint)]);
    EXPECT_FLOAT_EQ(problem.gate_view[i],
                    9.21f * map_.scales().sigma2[octave(pairs[i].view, pairs[i].view_keypoint)]);
  }
}

class Recheck : public Thresholds {};

TEST_F(Recheck, CountsAtTheirThresholds) {
  const Verified good = recheck();
  ASSERT_EQ(good.confirmations, 1) << good.report.reason;
  EXPECT_TRUE(good.report.recheck);
  const auto value = [&](const char* name) {
    return static_cast<int>(gate(good.report, name)->value);
  };
  EXPECT_EQ(gate(good.report, "refined inliers")->threshold, options_.min_recheck_inliers + 1);
  struct Case {
    const char* gate;
    int LoopOptions::*threshold;
    int last_good;
  };
  for (const Case& c :
       {Case{"projection matches", &LoopOptions::min_covisible_matches,
             value("projection matches")},
        {"refined inliers", &LoopOptions::min_recheck_inliers, value("refined inliers") - 1},
        {"projection matches after refinement", &LoopOptions::min_recheck_matches,
         value("projection matches after refinement")}}) {
    SCOPED_TRACE(c.gate);
    options_ = {};
    options_.*c.threshold = c.last_good;
    EXPECT_EQ(recheck().confirmations, 1);
    options_.*c.threshold = c.last_good + 1;
    const Verified refused = recheck();
    EXPECT_EQ(refused.confirmations, 0);
    EXPECT_EQ(refused.report.gates.back().gate, c.gate);
  }
}

TEST_F(Thresholds, CorrectionTakesKeyframesThatShareEnough) {
  // New observations are looked for in the current keyframe and those connected to it.
  const auto keyframes = [&] {
    CorrectionMemory memory;
    StageClock clock;
    const auto c =
        compute_correction(map_, confirmed().match, options_, executors_of(Backend::kCpu), memory, clock);
    std::set<KeyframeId> ids;
    for (const map::NewObservation& o : c.observations) ids.insert(o.keyframe);
    return ids;
  };
  options_.min_connection = 1;
  const std::set<KeyframeId> all = keyframes();
  int tried = 0;
  for (const map::CovisibilityEdge& e : map_.covisible(current_)) {
    if (!all.contains(e.keyframe) || ++tried > 4) continue;
    options_.min_connection = e.shared;
    EXPECT_TRUE(keyframes().contains(e.keyframe)) << e.shared;
    options_.min_connection = e.shared + 1;
    EXPECT_FALSE(keyframes().contains(e.keyframe)) << e.shared;
  }
  EXPECT_GT(tried, 2);
}

}  // namespace
}  // namespace fastloop::loop
