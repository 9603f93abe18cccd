#include <gtest/gtest.h>

#include <set>

#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/tracking/last_frame_search.hpp"
#include "fastloop/tracking/local_map.hpp"
#include "fastloop/tracking/relocalizer.hpp"

namespace fastloop::tracking {
namespace {

using map::testing::observe;
using map::testing::pose_at;
using map::testing::SyntheticMap;
using map::testing::SyntheticView;
using map::testing::SyntheticWorld;

/// Twelve keyframes on a line, the last but few as good as all.
class Search : public ::testing::Test {
 protected:
  Search() : world(1500, {4, 4, 2.5}, 1), m(world) {
    for (int i = 0; i < 12; ++i) m.add(pose_at({0, -0.15 * i, 0}, 0.05 * i), {}, rng, 0.7);
  }
  /// The last frame as tracked: at keyframe `k`, all landmarks of the keyframe.
  TrackedFrame frame_at(KeyframeId k) const {
    TrackedFrame f;
    f.features = m.views[k.value()].features;
    f.landmarks = m.map.keyframe(k).landmarks;
    f.state = m.map.keyframe(k).state;
    f.reference = k;
    return f;
  }
  std::mt19937 rng{1};
  const SyntheticWorld world;
  SyntheticMap m;
};

TEST_F(Search, LastFramePointsAreFoundAroundThePrediction) {
  const KeyframeId k(4);
  const TrackedFrame last = frame_at(k);
  const SE3 truth = m.truth[4] * SE3(so3::exp({0.01, -0.02, 0.01}), Vector3d(0.05, -0.04, 0.02));
  const SyntheticView view = observe(world, truth, {.clutter = 100}, rng);
  Vector6d error;
  error << 0.005, 0.005, -0.005, 0.01, 0.02, -0.01;
  const float close_m = 4.4f;
  const auto matches =
      search_last_frame(m.map, last, *view.features, truth.retract(error), 15, close_m);
  int landmarks = 0, stereo = 0, wrong = 0;
  std::set<std::uint32_t> taken;
  for (const PointMatch& match : matches) {
    EXPECT_TRUE(taken.insert(match.keypoint).second);
    const int p = view.point[match.keypoint];
    const bool right =
        p >= 0 && (world.points[static_cast<std::size_t>(p)] - match.p_world).norm() < 0.5;
    wrong += !right;
    ++(match.landmark.valid() ? landmarks : stereo);
    if (right && match.landmark.valid())
      EXPECT_EQ(match.landmark, m.landmark_of[static_cast<std::size_t>(p)]);
  }
  int in_both = 0;
  for (const LandmarkId l : last.landmarks) in_both += l.valid();
  EXPECT_GT(landmarks, in_both * 8 / 10);
  EXPECT_GT(stereo, 5);
  EXPECT_LE(wrong, static_cast<int>(matches.size() / 50));
}

TEST_F(Search, LastFrameFollowsMergedLandmarksAndLeavesFarStereoPoints) {
  TrackedFrame last = frame_at(KeyframeId(4));
  const SyntheticView view = observe(world, m.truth[4], {}, rng);
  LandmarkId loser, winner;
  for (const LandmarkId l : last.landmarks)
    if (l.valid()) (loser.valid() ? winner : loser) = l;
  m.map.replace_landmark(loser, winner);
  last.landmarks.assign(last.landmarks.size(), LandmarkId{});
  for (std::size_t i = 0; i < last.landmarks.size(); ++i)
    if (m.views[4].point[i] >= 0 &&
        m.landmark_of[static_cast<std::size_t>(m.views[4].point[i])] == loser)
      last.landmarks[i] = loser;
  const auto matches = search_last_frame(m.map, last, *view.features, m.truth[4], 15, 3.0f);
  ASSERT_FALSE(matches.empty());
  for (const PointMatch& match : matches) {
    if (match.landmark.valid()) EXPECT_EQ(match.landmark, winner);
    if (!match.landmark.valid())
      EXPECT_LT(((m.truth[4] * world.rig.T_body_left).inverse() * match.p_world).z(), 3.0);
  }
}

TEST_F(Search, LocalMapHoldsExactlyTheLandmarksOfItsKeyframes) {
  LocalMap local;
  for (const std::size_t limit : {2u, 5u, 8u, 40u, 5u}) {
    local.update(m.map, m.map.keyframe(KeyframeId(6)).landmarks, KeyframeId(11), limit);
    EXPECT_LE(local.keyframes().size(), limit);
    EXPECT_EQ(std::set<KeyframeId>(local.keyframes().begin(), local.keyframes().end()).size(),
              local.keyframes().size());
    EXPECT_EQ(local.keyframes().front(), KeyframeId(11)) << "temporal neighbours survive the cut";
    EXPECT_EQ(local.reference(), KeyframeId(6));
    std::set<LandmarkId> expected;
    for (const KeyframeId k : local.keyframes())
      for (const LandmarkId l : m.map.keyframe(k).landmarks)
        if (l.valid()) expected.insert(l);
    ASSERT_TRUE(
        std::equal(expected.begin(), expected.end(), local.ids().begin(), local.ids().end()));
    const auto view = local.view();
    for (std::size_t i = 0; i < local.ids().size(); ++i) {
      EXPECT_LT((view.p_world[i].cast<double>() - m.map.p_world(local.ids()[i])).norm(), 1e-5);
      EXPECT_LT((view.normal_world[i].cast<double>() - m.map.normal_world(local.ids()[i])).norm(),
                1e-5);
      EXPECT_EQ(view.descriptor[i], m.map.landmark(local.ids()[i]).descriptor);
    }
  }
}

TEST_F(Search, LocalMapFollowsMergedLandmarks) {
  // A frame that matched a landmark which mapping has merged into another since.
  LandmarkId loser, winner;
  for (const LandmarkId l : m.map.keyframe(KeyframeId(4)).landmarks)
    if (l.valid()) (loser.valid() ? winner : loser) = l;
  m.map.replace_landmark(loser, winner);
  LocalMap local;
  local.update(m.map, {loser}, KeyframeId{}, 10);
  ASSERT_TRUE(local.reference().valid());
  const auto& seen = m.map.keyframe(local.reference()).landmarks;
  EXPECT_NE(std::find(seen.begin(), seen.end(), winner), seen.end());
}

TEST_F(Search, LocalMapSurvivesRemovedAndMissingThings) {
  LocalMap local;
  local.update(m.map, {}, KeyframeId{}, 10);
  EXPECT_FALSE(local.reference().valid());
  EXPECT_TRUE(local.ids().empty());
  std::vector<LandmarkId> stale = m.map.keyframe(KeyframeId(6)).landmarks;
  stale.push_back(LandmarkId(1'000'000));
  m.map.remove_keyframe(KeyframeId(6));
  for (const LandmarkId l : stale)
    if (l.valid() && l.value() % 3 == 0 && m.map.contains(l)) m.map.remove_landmark(l);
  local.update(m.map, stale, KeyframeId(6), 10);
  EXPECT_TRUE(m.map.contains(local.reference()));
  for (const KeyframeId k : local.keyframes()) EXPECT_TRUE(m.map.contains(k));
  for (const LandmarkId l : local.ids()) EXPECT_TRUE(m.map.contains(l));
  EXPECT_GT(local.ids().size(), 50u);
}

/// Exchanges the descriptors of a share of the keypoints among themselves.
void mix_up(SyntheticView& view, double share, std::mt19937& rng) {
  std::vector<std::size_t> chosen;
  for (std::size_t i = 0; i < view.features->size(); ++i)
    if (static_cast<double>(rng() % 1000) < 1000 * share) chosen.push_back(i);
  for (std::size_t i = 0; i + 1 < chosen.size(); ++i) {
    const std::size_t j = i + 1 + rng() % (chosen.size() - i - 1);
    std::swap(view.features->descriptors[chosen[i]], view.features->descriptors[chosen[j]]);
  }
}

TEST_F(Search, RelocaliserFindsThePoseAmongWrongMatches) {
  for (int trial = 0; trial < 10; ++trial) {
    const SE3 truth = m.truth[static_cast<std::size_t>(trial)] *
                      SE3(so3::exp(map::testing::normal_vector(rng, 0.05)),
                          map::testing::normal_vector(rng, 0.15));
    SyntheticView view =
        observe(world, truth, {.noise_px = 0.5, .flipped_bits = 15, .clutter = 100}, rng);
    mix_up(view, 0.4, rng);
    Relocalizer relocaliser;
    const auto found = relocaliser.relocalise(m.map, *view.features, m.id, KeyframeId{}, 30);
    ASSERT_TRUE(found) << trial;
    EXPECT_LT(truth.local(found->T_world_body).norm(), 0.1);
    EXPECT_GE(found->inliers, 30);
    int matched = 0, wrong = 0;
    for (std::size_t i = 0; i < found->landmarks.size(); ++i) {
      if (!found->landmarks[i].valid()) continue;
      ++matched;
      wrong += view.point[i] < 0 ||
               m.landmark_of[static_cast<std::size_t>(view.point[i])] != found->landmarks[i];
    }
    EXPECT_EQ(matched, found->inliers);
    EXPECT_LE(wrong, 2);
  }
}

TEST_F(Search, RelocaliserRefusesUnrelatedFrames) {
  const SyntheticWorld elsewhere(1500, {4, 4, 2.5}, 99);
  Relocalizer relocaliser;
  const SyntheticView other = observe(elsewhere, m.truth[5], {}, rng);
  EXPECT_FALSE(relocaliser.relocalise(m.map, *other.features, m.id, KeyframeId(5), 15));
  SyntheticView shuffled = observe(world, m.truth[5], {}, rng);
  mix_up(shuffled, 1.0, rng);
  EXPECT_FALSE(relocaliser.relocalise(m.map, *shuffled.features, m.id, KeyframeId(5), 15));
  const SyntheticView same = observe(world, m.truth[5], {}, rng);
  EXPECT_TRUE(relocaliser.relocalise(m.map, *same.features, m.id, KeyframeId(5), 15));
  EXPECT_FALSE(relocaliser.relocalise(m.map, *same.features, MapId(1), KeyframeId(5), 15))
      << "another map";
}

TEST_F(Search, RelocaliserAsksItsSource) {
  Relocalizer relocaliser;
  relocaliser.set_candidate_source(
      [](const FeatureSet&, const map::Snapshot&) { return std::vector{KeyframeId(7)}; });
  const SyntheticView view = observe(world, m.truth[7], {}, rng);
  const auto found = relocaliser.relocalise(m.map, *view.features, m.id, KeyframeId{}, 15);
  ASSERT_TRUE(found);
  EXPECT_EQ(found->keyframe, KeyframeId(7));
}

}  // namespace
}  // namespace fastloop::tracking
