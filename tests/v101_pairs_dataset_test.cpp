// Loop detection on recorded images: 100 stereo pairs of EuRoC V1_01, about one a second, from the
// folder FASTLOOP_DATA; skipped where it is absent.
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>

#include "fastloop/features/frame_builder.hpp"
#include "fastloop/io/dataset.hpp"
#include "fastloop/io/trajectory.hpp"
#include "fastloop/loop/detection.hpp"
#include "fastloop/loop/keyframe_search.hpp"
#include "fastloop/map/map.hpp"
#include "fastloop/place/default_vocabulary.hpp"

namespace fastloop::loop {
namespace {

namespace fs = std::filesystem;

constexpr Nanoseconds kApart = 10'000'000'000;

/// Every pair as a keyframe at its true pose, with landmarks from stereo. What the last few pairs
/// saw is searched in each new one, so that neighbours in time share landmarks as in a tracked map.
struct Pairs {
  std::unique_ptr<map::Map> map;
  std::vector<KeyframeId> keyframes;
  std::vector<place::PlaceDatabase::Words> words;

  explicit Pairs(const fs::path& folder) {
    const auto dataset = io::open_dataset(folder);
    FrameBuilder builder(dataset->calibration(), OrbOptions{});
    map = std::make_unique<map::Map>(builder.rig(), PyramidScales());
    const MapId id = map->start_map();
    const place::PlaceDatabase database(place::default_vocabulary());
    const auto truth = io::read_trajectory(folder / "V1_01_easy_openvins_corrected_tum.txt").poses;
    for (std::size_t f = 0; f < dataset->size(); ++f) {
      const auto at = std::lower_bound(truth.begin(), truth.end(), dataset->stamp_ns(f),
                                       [](const auto& p, Nanoseconds t) { return p.stamp_ns < t; });
      if (at == truth.end() || at == truth.begin()) continue;
      const auto& pose =
          at->stamp_ns - dataset->stamp_ns(f) < dataset->stamp_ns(f) - std::prev(at)->stamp_ns
              ? *at
              : *std::prev(at);
      if (std::abs(pose.stamp_ns - dataset->stamp_ns(f)) > 30'000'000) continue;
      NavState state;
      state.T_world_body = pose.T_world_x;
      add(id, dataset->stamp_ns(f),
          std::make_shared<const FeatureSet>(builder.build(dataset->load(f))), state);
      words.push_back(
          database.words_of(map->keyframe(keyframes.back()).data->features->descriptors));
    }
  }

  void add(MapId id, Nanoseconds stamp_ns, std::shared_ptr<const FeatureSet> features,
           const NavState& state) {
    auto data = std::make_shared<map::KeyframeData>();
    data->stamp_ns = stamp_ns;
    data->features = features;
    const KeyframeId k = map->add_keyframe(id, data, state, nullptr);
    const SE3 T_world_left = state.T_world_body * map->rig().T_body_left;
    const std::span<const KeyframeId> before(keyframes);
    const map::LandmarkArrays known(
        *map, map::landmarks_of(*map, before.last(std::min<std::size_t>(5, before.size()))));
    const MovedKeyframe here{k, T_world_left.inverse()};
    const auto seen = search_keyframes(Executor::cpu(), *map, {&here, 1}, known, 6, 50).front();
    for (std::size_t i = 0; i < known.size(); ++i)
      if (seen.keypoint[i] != matching::kNoMatch) {
        map->add_observation(known.ids[i], k, static_cast<std::uint32_t>(seen.keypoint[i]));
        map->refresh_landmark(known.ids[i]);
      }
    for (std::uint32_t i = 0; i < features->size(); ++i)
      if (features->has_depth(i) && !map->keyframe(k).landmarks[i].valid())
        map->add_landmark(k, i,
                          T_world_left * map->rig().point_at_depth({features->x[i], features->y[i]},
                                                                   features->depth_m[i]));
    keyframes.push_back(k);
  }

  bool apart(KeyframeId a, KeyframeId b) const {
    return std::abs(map->keyframe(a).data->stamp_ns - map->keyframe(b).data->stamp_ns) > kApart;
  }
  bool revisit(KeyframeId a, KeyframeId b) const {
    const SE3 x = map->T_world_camera(a), y = map->T_world_camera(b);
    return apart(a, b) && (x.translation - y.translation).norm() <= 1 &&
           angle_between(x, y) <= 20 * M_PI / 180;
  }
};

const GateReading* find_gate(const CandidateReport& report, const char* name) {
  for (const GateReading& g : report.gates)
    if (g.gate == name) return &g;
  return nullptr;
}

TEST(V101Pairs, RevisitsAreRetrievedAndNoVerifiedPairIsWrong) {
  const char* given = std::getenv("FASTLOOP_DATA");
  const fs::path folder = fs::path(given ? given : FASTLOOP_DEFAULT_DATA) / "euroc_v101_sparse";
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const Pairs pairs(folder);
  ASSERT_GT(pairs.keyframes.size(), 90u);
  LoopOptions options;
  const Verifier verifier(options, Executor::cpu());
  int queries = 0, answered = 0, in_region = 0, verified = 0, wrong = 0;
  for (std::size_t q = 0; q < pairs.keyframes.size(); ++q) {
    const KeyframeId current = pairs.keyframes[q];
    place::PlaceDatabase database(place::default_vocabulary());
    database.insert(current, pairs.words[q]);
    bool has_revisit = false;
    for (std::size_t k = 0; k < pairs.keyframes.size(); ++k) {
      if (!pairs.apart(current, pairs.keyframes[k])) continue;
      database.insert(pairs.keyframes[k], pairs.words[k]);
      has_revisit |= pairs.revisit(current, pairs.keyframes[k]);
    }
    LoopDetector detector(options, Executor::cpu());
    const LoopReport report = detector.detect(*pairs.map, current, database).report;
    ASSERT_LE(report.candidates.size(), 3u);
    bool found = false, region = false;
    for (const CandidateReport& c : report.candidates) {
      found |= pairs.revisit(current, c.keyframe);
      for (const KeyframeId k : window_of(*pairs.map, c.keyframe, options.window_covisibles))
        region |= pairs.revisit(current, k);
      const GateReading* confirmed = find_gate(c, "confirming covisible keyframes");
      if (!confirmed || !confirmed->passed) continue;
      Verified again;
      again.report.keyframe = c.keyframe;
      StageClock clock;
      verifier.verify(*pairs.map, current, database, {&again, 1}, clock);
      ASSERT_GT(again.match.num_matches, 0);
      // The map has true poses: the match must find the keyframe where it is.
      const SE3 error = again.match.T_camera_world * pairs.map->T_world_camera(current);
      ++verified;
      wrong += error.translation.norm() > 0.5 || angle_between(error, SE3()) > 5 * M_PI / 180;
    }
    queries += has_revisit;
    answered += has_revisit && found;
    in_region += has_revisit && region;
  }
  std::printf(
      "%d queries with a revisit within 1 m and 20 deg: one of three candidates is one in %d "
      "(%.0f %%), its surroundings hold one in %d (%.0f %%); %d pairs verified, %d wrong\n",
      queries, answered, 100.0 * answered / queries, in_region, 100.0 * in_region / queries,
      verified, wrong);
  EXPECT_GT(queries, 10);
  // A candidate stands for a group of covisible keyframes, all of which are matched; the index
  // alone is measured by PlaceRecall.
  EXPECT_GE(in_region, 0.8 * queries);
  EXPECT_GT(verified, 0);
  EXPECT_EQ(wrong, 0);
}

}  // namespace
}  // namespace fastloop::loop
