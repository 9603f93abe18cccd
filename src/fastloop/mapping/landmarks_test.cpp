#include <gtest/gtest.h>

#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/mapping/culling.hpp"
#include "fastloop/mapping/landmark_creation.hpp"
#include "fastloop/mapping/landmark_fusion.hpp"

namespace fastloop::mapping {
namespace {

using map::testing::observe;
using map::testing::pose_at;
using map::testing::SyntheticMap;
using map::testing::SyntheticView;
using map::testing::SyntheticWorld;
using map::testing::ViewOptions;

const Vector3d kRoom(5, 5, 2.5);

/// The world point a keypoint of a keyframe shows.
int point_of(const SyntheticMap& m, const map::Observation& o) {
  return m.views[o.keyframe.value()].point[o.keypoint];
}

TEST(CreateFromStereo, TakesAllClosePointsAtTheirPlace) {
  std::mt19937 rng(1);
  const SyntheticWorld world(1500, kRoom, 1);
  SyntheticMap m(world);
  const KeyframeId k =
      m.add(pose_at({0, 0, 0}, 0.3), {.noise_px = 0, .stereo_share = 0.7}, rng, 0.3);
  const MappingOptions options;
  const float close = static_cast<float>(options.close_depth_baselines * world.rig.baseline_m);
  const std::vector<LandmarkId> before = m.map.keyframe(k).landmarks;
  const auto created = create_from_stereo(m.map, k, options);
  ASSERT_FALSE(created.empty());
  const FeatureSet& f = *m.views[0].features;
  int close_points = 0;
  for (std::uint32_t i = 0; i < f.size(); ++i) {
    const LandmarkId l = m.map.keyframe(k).landmarks[i];
    if (before[i].valid()) EXPECT_EQ(l, before[i]);
    if (!f.has_depth(i) && !before[i].valid()) EXPECT_FALSE(l.valid());
    if (f.has_depth(i) && f.depth_m[i] <= close) {
      ++close_points;
      EXPECT_TRUE(l.valid());
    }
    if (l.valid())
      EXPECT_LT(
          (m.map.p_world(l) - world.points[static_cast<std::size_t>(m.views[0].point[i])]).norm(),
          5e-3);
  }
  EXPECT_GT(close_points, 20);
  EXPECT_FALSE(m.map.find_inconsistency());
}

TEST(CreateFromStereo, FillsUpWithTheNearestFarPoints) {
  std::mt19937 rng(2);
  const SyntheticWorld world(1500, kRoom, 2);
  SyntheticMap m(world);
  const KeyframeId k = m.add(pose_at({0, 0, 0}, 0), {.noise_px = 0}, rng, 0);
  MappingOptions options;
  options.close_depth_baselines = 1;  // nothing is that close
  options.min_stereo_landmarks = 40;
  EXPECT_EQ(create_from_stereo(m.map, k, options).size(), 40u);
  float farthest_taken = 0, nearest_left = 1e9f;
  const FeatureSet& f = *m.views[0].features;
  for (std::size_t i = 0; i < f.size(); ++i) {
    if (!f.has_depth(i)) continue;
    if (m.map.keyframe(k).landmarks[i].valid())
      farthest_taken = std::max(farthest_taken, f.depth_m[i]);
    else
      nearest_left = std::min(nearest_left, f.depth_m[i]);
  }
  EXPECT_LE(farthest_taken, nearest_left);
}

class Triangulation : public ::testing::TestWithParam<double> {};

TEST_P(Triangulation, FindsPointsOfTwoKeyframesWithinTolerance) {
  std::mt19937 rng(3);
  const SyntheticWorld world(1500, kRoom, 3);
  SyntheticMap m(world);
  const ViewOptions view{.noise_px = 0.2, .stereo_share = GetParam()};
  KeyframeId k;
  for (int i = 0; i < 4; ++i) k = m.add(pose_at({0, -0.4 * i, 0.05 * i}, 0.03 * i), view, rng, 0.3);
  const auto created = create_by_triangulation(m.map, k, {});
  EXPECT_GT(created.size(), 60u);
  int wrong = 0;
  std::vector<double> errors;
  for (const LandmarkId l : created) {
    const auto& seen = m.map.landmark(l).observations;
    ASSERT_EQ(seen.size(), 2u);
    if (point_of(m, seen[0]) != point_of(m, seen[1])) {
      ++wrong;
      continue;
    }
    const Vector3d truth = world.points[static_cast<std::size_t>(point_of(m, seen[0]))];
    errors.push_back((m.map.p_world(l) - truth).norm());
  }
  EXPECT_LE(wrong, static_cast<int>(created.size() / 50));
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 0.06);
  EXPECT_LT(errors[errors.size() * 95 / 100], 0.4);
  EXPECT_FALSE(m.map.find_inconsistency());
}

INSTANTIATE_TEST_SUITE_P(StereoShare, Triangulation, ::testing::Values(0.0, 0.5, 1.0));

TEST(CreateByTriangulation, NeedsABaseline) {
  std::mt19937 rng(4);
  const SyntheticWorld world(1000, kRoom, 4);
  SyntheticMap m(world);
  for (int i = 0; i < 3; ++i) m.add(pose_at({0, -0.02 * i, 0}, 0), {.stereo_share = 0}, rng, 0.3);
  EXPECT_TRUE(create_by_triangulation(m.map, KeyframeId(2), {}).empty());
}

TEST(FuseWithNeighbours, MergesDuplicatesAndNothingElse) {
  std::mt19937 rng(5);
  const SyntheticWorld world(1200, kRoom, 5);
  SyntheticMap m(world);
  const ViewOptions view{.noise_px = 0.2};
  m.add(pose_at({0, 0, 0}, 0), view, rng);
  m.add(pose_at({0, -0.2, 0}, 0), view, rng);
  const std::vector<LandmarkId> first = m.landmark_of;
  std::fill(m.landmark_of.begin() + 200, m.landmark_of.end(),
            LandmarkId{});  // the third creates them again
  const KeyframeId k = m.add(pose_at({0, -0.4, 0}, 0), view, rng);
  const std::vector<LandmarkId> second = m.landmark_of;
  EXPECT_GT(fuse_with_neighbours(m.map, k, {}), 100);
  ASSERT_FALSE(m.map.find_inconsistency());
  int duplicates = 0, merged = 0;
  for (std::size_t p = 200; p < first.size(); ++p) {
    if (!first[p].valid() || !second[p].valid()) continue;
    ++duplicates;
    merged += m.map.resolve(first[p]) == m.map.resolve(second[p]);
  }
  EXPECT_GT(duplicates, 100);
  EXPECT_GT(merged, duplicates * 9 / 10);
  for (std::uint32_t i = 0; i < m.map.landmark_slots(); ++i) {
    if (!m.map.contains(LandmarkId(i))) continue;
    const auto& seen = m.map.landmark(LandmarkId(i)).observations;
    for (const map::Observation& o : seen) EXPECT_EQ(point_of(m, o), point_of(m, seen.front()));
  }
}

/// Two views whose points look the same and lie on the same rays, but three metres apart.
TEST(FuseWithNeighbours, KeepsWhatIsThreeMetresApart) {
  std::mt19937 rng(6);
  const SyntheticWorld near_world(600, {3, 3, 2}, 6);
  const SE3 T(pose_at({0, 0, 0}, 0));
  SyntheticWorld far_world = near_world;
  for (Vector3d& p : far_world.points)
    p += 3 * (p - (T * near_world.rig.T_body_left).translation).normalized();
  const ViewOptions view{.noise_px = 0.2, .flipped_bits = 2};
  SyntheticMap near_map(near_world);
  near_map.add(T, view, rng);
  const SyntheticView other = observe(far_world, T, view, rng);
  map::Map& map = near_map.map;
  NavState state;
  state.T_world_body = T;
  const KeyframeId k =
      map.add_keyframe(near_map.id, keyframe_data(other, FrameId(1), 200'000'000), state, nullptr);
  std::size_t created = 0;
  for (std::uint32_t i = 0; i < other.point.size(); ++i, ++created)
    map.add_landmark(k, i, far_world.points[static_cast<std::size_t>(other.point[i])]);
  map.attach_to_spanning_tree(k);
  const std::size_t before = map.num_landmarks();
  ASSERT_GT(created, 50u);
  fuse_with_neighbours(map, k, {});
  EXPECT_EQ(map.num_landmarks(), before);
  EXPECT_FALSE(map.find_inconsistency());
}

TEST(LandmarkProbation, RemovesTheUnconfirmedAndTheRarelyFound) {
  std::mt19937 rng(7);
  const SyntheticWorld world(400, kRoom, 7);
  SyntheticMap m(world);
  m.add(pose_at({0, 0, 0}, 0), {}, rng, 1);
  std::vector<LandmarkId> created;
  for (const LandmarkId l : m.map.keyframe(KeyframeId(0)).landmarks)
    if (l.valid()) created.push_back(l);
  ASSERT_GE(created.size(), 4u);
  LandmarkProbation probation;
  probation.add(created);
  m.map.count_visible(created[0], 9, 1);  // found 2 of 10
  m.map.count_visible(created[1], 9, 3);
  probation.review(m.map, KeyframeId(0));
  EXPECT_FALSE(m.map.contains(created[0]));
  EXPECT_TRUE(m.map.contains(created[1]));

  // The next keyframe sees only half of them again.
  for (std::size_t i = created.size() / 2; i < created.size(); ++i)
    for (LandmarkId& l : m.landmark_of)
      if (l == created[i]) l = LandmarkId{};
  m.add(pose_at({0, -0.1, 0}, 0), {}, rng, 1);
  probation.review(m.map, KeyframeId(1));
  EXPECT_EQ(m.map.contains(created.back()), true);
  m.add(pose_at({0, -0.2, 0}, 0), {}, rng, 1);
  probation.review(m.map, KeyframeId(2));
  EXPECT_FALSE(m.map.contains(created.back()));
  std::size_t kept = 0;
  for (const LandmarkId l : created) {
    if (m.map.contains(l)) EXPECT_GE(m.map.landmark(l).observations.size(), 2u);
    kept += m.map.contains(l);
  }
  EXPECT_GT(kept, created.size() / 4);

  // After three keyframes nobody looks any more.
  probation.review(m.map, KeyframeId(5));
  LandmarkId survivor;
  for (const LandmarkId l : created)
    if (m.map.contains(l)) survivor = l;
  m.map.count_visible(survivor, 100, 0);
  probation.review(m.map, KeyframeId(6));
  EXPECT_TRUE(m.map.contains(survivor));
  EXPECT_FALSE(m.map.find_inconsistency());
}

}  // namespace
}  // namespace fastloop::mapping
