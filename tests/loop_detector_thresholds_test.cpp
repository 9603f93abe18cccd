#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/map/ring_map_for_tests.hpp"
#include "loop_thresholds.hpp"

/// Thresholds of the detector and of what follows it; the list of all is in loop_thresholds_test.
namespace fastloop::loop {
namespace {

using testing::describe;
using testing::known;
using testing::Thresholds;

class Detector : public Thresholds {};

TEST_F(Detector, ReadyOnlyOfASettledMap) {
  const std::string reason = "the map is too small or its IMU not settled";
  options_.min_keyframes = map_.map_info(map_.keyframe(current_).map).num_keyframes;
  EXPECT_NE(detect().report.reason, reason);
  ++options_.min_keyframes;
  EXPECT_EQ(detect().report.reason, reason);
  options_.min_keyframes = 12;
  options_.inertial = true;
  map::Map map(map_);
  map::MapInfo& info = map.mutable_info(map.keyframe(current_).map);
  for (const bool initialized : {false, true})
    for (const int refinements : {1, 2}) {
      info.imu_initialized = initialized;
      info.imu_refinements = refinements;
      LoopDetector detector(options_, Executor::cpu());
      const auto r = detector.detect(map, current_, known().closer.database());
      EXPECT_EQ(r.report.reason != reason, initialized && refinements == 2);
    }
}

TEST_F(Detector, KindsOfLoops) {
  EXPECT_FALSE(detect().report.candidates.empty());
  options_.close_loops = false;  // there is one map only
  EXPECT_TRUE(detect().report.candidates.empty());
}

TEST_F(Detector, NumberOfCandidates) {
  options_.window_covisibles = 0;  // every keyframe stands for itself
  options_.min_shared_ratio = 0.2f;
  options_.candidates = 5;
  const auto all = detect().report.candidates;
  ASSERT_EQ(all.size(), 5u);
  for (std::size_t n = 1; n < 5; ++n) {
    options_.candidates = n;
    const auto some = detect().report.candidates;
    ASSERT_EQ(some.size(), n);
    for (std::size_t i = 0; i < n; ++i) EXPECT_EQ(some[i].keyframe, all[i].keyframe);
  }
  options_.candidates = 5;
  for (const int n : {4, 5}) {
    options_.ranked_candidates = n;
    EXPECT_EQ(detect().report.candidates.size(), static_cast<std::size_t>(n));
  }
  for (const CandidateReport& c : all) EXPECT_EQ(map_.num_shared(c.keyframe, current_), 0);
}

TEST_F(Detector, SharedWords) {
  // The group member with most words decides how many a candidate needs.
  options_.candidates = 1000;
  options_.ranked_candidates = 1000;
  options_.window_covisibles = 0;
  options_.min_shared_ratio = 0;
  const auto all = detect().report.candidates;
  int most = 0;
  for (const CandidateReport& c : all) most = std::max(most, c.shared_words);
  for (const CandidateReport& edge : all) {
    // At this ratio the candidate has exactly as many words as are too few.
    const float ratio = static_cast<float>(edge.shared_words) / static_cast<float>(most);
    if (ratio < 0.3f || ratio > 0.9f) continue;
    for (const float off : {-1e-4f, 1e-4f}) {
      options_.min_shared_ratio = ratio + off;
      std::size_t expected = 0;
      for (const CandidateReport& c : all)
        expected +=
            off < 0 ? c.shared_words >= edge.shared_words : c.shared_words > edge.shared_words;
      EXPECT_EQ(detect().report.candidates.size(), expected);
    }
    return;
  }
  FAIL() << "no candidate with a middling number of words";
}

class Waiting : public Thresholds {
 protected:
  /// Seen from the keyframe before the current one.
  WaitingRegion region(bool right) const {
    WaitingRegion w;
    w.last_keyframe = KeyframeId(current_.value() - 1);
    w.matched = matched_;
    const SE3 T_last_current =
        map_.T_world_camera(w.last_keyframe).inverse() * map_.T_world_camera(current_);
    w.T_last_matched =
        T_last_current * confirmed().match.T_camera_world * map_.T_world_camera(matched_);
    if (!right) w.T_last_matched.translation += Vector3d(50, 0, 0);
    w.confirmations = 1;
    return w;
  }
};

TEST_F(Waiting, ConfirmationsAtOnce) {
  // As many as there are.
  options_.confirmations = 100;
  LoopDetector detector(options_, Executor::cpu());
  const auto first = detector.detect(map_, current_, known().closer.database());
  EXPECT_EQ(first.report.verdict, Verdict::kWaiting) << describe(first.report);
  EXPECT_FALSE(first.match.has_value());
  ASSERT_TRUE(detector.waiting().loop.has_value());
  const int agreed = detector.waiting().loop->confirmations;
  ASSERT_GT(agreed, 1);
  options_.confirmations = agreed;
  EXPECT_EQ(detect().report.verdict, Verdict::kAccepted);
  EXPECT_TRUE(detect().match.has_value());
  options_.confirmations = agreed + 1;
  EXPECT_EQ(detect().report.verdict, Verdict::kWaiting);
}

TEST_F(Waiting, ConfirmationsByLaterKeyframes) {
  for (const int before : {1, 2}) {
    LoopDetector detector(options_, Executor::cpu());
    LoopDetector::Waiting waiting;
    waiting.loop = region(true);
    waiting.loop->confirmations = before;
    waiting.loop->misses = 1;
    detector.set_waiting(waiting);
    const auto r = detector.detect(map_, current_, known().closer.database());
    const bool enough = before + 1 >= options_.confirmations;
    EXPECT_EQ(r.match.has_value(), enough);
    EXPECT_EQ(r.report.verdict, enough ? Verdict::kAccepted : Verdict::kWaiting);
    EXPECT_EQ(detector.waiting().loop.has_value(), !enough);
    if (!enough) {
      EXPECT_EQ(detector.waiting().loop->confirmations, before + 1);
      EXPECT_EQ(detector.waiting().loop->misses, 0);
      EXPECT_EQ(detector.waiting().loop->last_keyframe, current_);
    }
  }
}

TEST_F(Waiting, MissesUntilItIsGivenUp) {
  options_.close_loops = false;  // nothing new is looked for
  for (const int misses : {1, 2, 3}) {
    options_.max_misses = misses;
    LoopDetector detector(options_, Executor::cpu());
    LoopDetector::Waiting waiting;
    waiting.loop = region(false);
    detector.set_waiting(waiting);
    for (int i = 1; i <= misses; ++i) {
      ASSERT_TRUE(detector.waiting().loop.has_value());
      const auto r = detector.detect(map_, current_, known().closer.database());
      ASSERT_EQ(r.report.candidates.size(), 1u);
      EXPECT_TRUE(r.report.candidates[0].recheck);
      EXPECT_EQ(detector.waiting().loop.has_value(), i < misses);
    }
  }
}

TEST_F(Waiting, IsForgottenWhenItsKeyframeIsGone) {
  map::Map map(map_);
  map.remove_keyframe(matched_);
  options_.close_loops = false;
  LoopDetector detector(options_, Executor::cpu());
  LoopDetector::Waiting waiting;
  waiting.loop = region(true);
  detector.set_waiting(waiting);
  EXPECT_TRUE(detector.detect(map, current_, known().closer.database()).report.candidates.empty());
  EXPECT_FALSE(detector.waiting().loop.has_value());
}

TEST_F(Detector, AmbiguousPlaces) {
  // Candidates of the true place, each with a small window of its own, and how far their poses lie
  // apart.
  options_.candidates = 5;
  options_.window_covisibles = 2;
  options_.min_shared_ratio = 0.2f;
  options_.min_wide_matches = options_.min_narrow_matches = 30;
  options_.min_covisible_matches = 10;
  options_.confirmations = 1;
  const LoopOptions easy = options_;
  const auto base = detect();
  ASSERT_TRUE(base.match.has_value()) << describe(base.report);
  double metres = 0, radians = 0;
  int verified = 0;
  for (const CandidateReport& c : base.report.candidates) {
    const Verified v = verify(c.keyframe);
    if (v.confirmations == 0 || c.keyframe == base.match->matched) continue;
    ++verified;
    const SE3 a = v.match.T_camera_world.inverse(), b = base.match->T_camera_world.inverse();
    metres = std::max(metres, (a.translation - b.translation).norm());
    radians = std::max(radians, angle_between(a, b));
  }
  ASSERT_GT(verified, 0);
  ASSERT_GT(metres, 0);
  ASSERT_GT(radians, 0);
  struct Case {
    double LoopOptions::*bound;
    double value;
  };
  for (const Case& c : {Case{&LoopOptions::ambiguous_distance_m, metres},
                        {&LoopOptions::ambiguous_angle_rad, radians}})
    for (const double factor : {1 - 1e-6, 1 + 1e-6}) {
      options_ = easy;
      options_.*c.bound = c.value * factor;
      const auto r = detect();
      EXPECT_EQ(r.match.has_value(), factor > 1);
      if (factor < 1) {
        EXPECT_EQ(
            std::count_if(r.report.candidates.begin(), r.report.candidates.end(),
                          [](const auto& x) { return x.reason.starts_with("ambiguous"); }) >= 2,
            true);
      }
    }
}

TEST(EssentialGraph, KeyframesThatShareEnoughAreNeighbours) {
  const map::Map ring = map::testing::ring_map({});
  const map::ClosedLoop loop = map::testing::ring_loop(ring);
  const auto edges = [&](int min_shared) {
    map::EssentialGraphOptions o;
    o.kind = optimization::PoseGraphKind::kSim3;
    o.min_shared = min_shared;
    map::EssentialGraph graph;
    map::build_essential_graph(ring, MapId(0), loop, o, graph);
    return graph.problem.edges.size();
  };
  for (const int shared : {150, 200, 250}) {
    std::size_t pairs = 0;  // that share exactly so much and are not neighbours for another reason
    for (std::uint32_t i = 0; i < ring.keyframe_slots(); ++i)
      for (const map::CovisibilityEdge& e : ring.covisible(KeyframeId(i)))
        pairs += e.keyframe < KeyframeId(i) && e.shared == shared &&
                 ring.keyframe(KeyframeId(i)).parent != e.keyframe;
    EXPECT_GT(pairs, 80u);
    EXPECT_EQ(edges(shared), edges(shared - 1));
    EXPECT_EQ(edges(shared) - edges(shared + 1), pairs);
  }
}

TEST(Closer, ForgetsARemovedKeyframeTwentyKeyframesLater) {
  map::Map map(known().world.map);
  const KeyframeId removed(60), first(70);
  map.remove_keyframe(removed);
  LoopOptions options;
  options.min_keyframes = 100'000;  // nothing but the bookkeeping
  LoopCloser closer(options, Backend::kCpu, place::default_vocabulary());
  closer.add_all(*known().snapshot);
  const auto process = [&](std::uint32_t later) {
    closer.process(map, KeyframeId(first.value() + later));
    return closer.database().words(removed) != nullptr;
  };
  EXPECT_TRUE(process(0));
  EXPECT_TRUE(process(19));
  EXPECT_FALSE(process(20));
}

TEST(LoopOptions, RefuseWhatHasNoMeaning) {
  struct Case {
    const char* name;
    void (*good)(LoopOptions&);
    void (*bad)(LoopOptions&);
  };
  for (const Case& c : {
           Case{"candidates", [](auto& o) { o.candidates = 1; }, [](auto& o) { o.candidates = 0; }},
           {"ranked_candidates", [](auto& o) { o.ranked_candidates = 1; },
            [](auto& o) { o.ranked_candidates = 0; }},
           {"min_shared_ratio", [](auto& o) { o.min_shared_ratio = 0.99f; },
            [](auto& o) { o.min_shared_ratio = 1; }},
           {"min_shared_ratio", [](auto& o) { o.min_shared_ratio = 0; },
            [](auto& o) { o.min_shared_ratio = -0.01f; }},
           {"min_ransac_inliers", [](auto& o) { o.min_ransac_inliers = 3; },
            [](auto& o) { o.min_ransac_inliers = 2; }},
           {"radii", [](auto& o) { o.fusion_radius_px = 0.1f; },
            [](auto& o) { o.fusion_radius_px = 0; }},
           {"radii", [](auto& o) { o.wide_radius_px = 0.1f; },
            [](auto& o) { o.wide_radius_px = 0; }},
           {"confirmations", [](auto& o) { o.confirmations = 1; },
            [](auto& o) { o.confirmations = 0; }},
           {"max_misses", [](auto& o) { o.max_misses = 1; }, [](auto& o) { o.max_misses = 0; }},
           {"max_tilt_rad", [](auto& o) { o.max_tilt_rad = 1e-9; },
            [](auto& o) { o.max_tilt_rad = 0; }},
           {"max_drift_ratio", [](auto& o) { o.max_drift_ratio = 0; },
            [](auto& o) { o.max_drift_ratio = -1e-9; }},
           {"connections", [](auto& o) { o.min_connection = 1; },
            [](auto& o) { o.min_connection = 0; }},
           {"graph_threads", [](auto& o) { o.graph_threads = 1; },
            [](auto& o) { o.graph_threads = 0; }},
       }) {
    LoopOptions options;
    c.good(options);
    EXPECT_NO_THROW(options.validate()) << c.name;
    c.bad(options);
    try {
      options.validate();
      ADD_FAILURE() << c.name;
    } catch (const InvalidArgument& e) {
      EXPECT_NE(std::string(e.what()).find(c.name), std::string::npos) << e.what();
    }
  }
}

}  // namespace
}  // namespace fastloop::loop
