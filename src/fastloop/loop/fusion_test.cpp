#include "fastloop/loop/fusion.hpp"

#include <gtest/gtest.h>

#include <map>
#include <set>

#include "fastloop/compute/executors_for_tests.hpp"
#include "fastloop/loop/connections.hpp"
#include "fastloop/loop/correspondences.hpp"
#include "fastloop/loop/verification.hpp"
#include "fastloop/map/expectations_for_tests.hpp"
#include "fastloop/map/loop_map_for_tests.hpp"

/// Loop fusion, new connections and the joining of landmarks on generated loops: all back ends to
/// the last integer, and against what the headers promise.
namespace fastloop::loop {
namespace {

using map::Map;
using map::testing::LoopMap;
using map::testing::LoopMapOptions;

bool operator==(const Fusion& a, const Fusion& b) {
  const auto same = [](const auto& x, const auto& y, auto equal) {
    return std::equal(x.begin(), x.end(), y.begin(), y.end(), equal);
  };
  return same(a.merges, b.merges,
              [](const auto& x, const auto& y) {
                return x.loser == y.loser && x.winner == y.winner;
              }) &&
         same(a.observations, b.observations, [](const auto& x, const auto& y) {
           return x.landmark == y.landmark && x.keyframe == y.keyframe && x.keypoint == y.keypoint;
         });
}

/// A fusion problem on a generated map.
struct Problem {
  LoopOptions options;
  RegionMatch match;
  std::vector<MovedKeyframe> moved;
  map::LandmarkArrays cloud;
};

SE3 jolted(const SE3& T, double size, std::mt19937& rng) {
  std::normal_distribution<double> n(0, size);
  Vector6d d;
  for (int k = 0; k < 6; ++k) d[k] = n(rng);
  return T.retract(d);
}

Problem problem_of(const LoopMap& loop, unsigned seed) {
  std::mt19937 rng(seed);
  const Map& m = loop.map();
  Problem p;
  const KeyframeId current = loop.late.back(), matched = loop.early[rng() % loop.early.size()];
  const double jolt = seed % 3 == 0 ? 0.01 : 0.001;
  for (const KeyframeId id : loop.late)
    if (id == current || rng() % 5 != 0)
      p.moved.push_back({id, jolted(loop.true_camera(id), jolt, rng)});
  if (seed % 8 == 1) std::swap(p.moved.front(), p.moved.back());
  if (seed % 10 == 2) p.moved.pop_back();  // the current keyframe itself, or the last one left
  // Usually what the early keyframes see; now and then everything, the searchers' own included.
  std::vector<KeyframeId> window = window_of(m, matched, 10);
  if (seed % 6 == 3) window.insert(window.end(), loop.late.begin(), loop.late.end());
  std::vector<LandmarkId> ids = map::landmarks_of(m, window);
  if (seed % 13 == 4) ids.clear();
  if (seed % 13 == 5) ids.resize(std::min<std::size_t>(ids.size(), 1));
  p.cloud = map::LandmarkArrays(m, ids);
  const SE3 T_camera_world = jolted(loop.true_camera(current), jolt, rng);
  const MovedKeyframe one{current, T_camera_world};
  const PlaceSearch place{&p.cloud, {&one, 1}, nullptr};
  const auto found = find_in_keyframes(Executor::reference(), m, {&place, 1}, 8, 75);
  p.match = make_region_match(m, current, matched, T_camera_world, p.cloud, found[0]);
  // Confirmed matches that contradict what is found: anything may be claimed.
  if (seed % 4 == 2 && !ids.empty())
    for (LandmarkId& l : p.match.landmarks)
      if (rng() % 6 == 0) l = ids[rng() % ids.size()];
  p.options.fusion_radius_px = seed % 5 == 0 ? 20 : 4;
  p.options.fusion_max_distance = seed % 5 == 0 ? 255 : 50;
  return p;
}

/// What the header promises of any fusion.
void expect_sound(const Map& m, const Fusion& f) {
  std::set<LandmarkId> losers;
  for (std::size_t i = 0; i < f.merges.size(); ++i) {
    if (i > 0) {
      ASSERT_LT(f.merges[i - 1].loser, f.merges[i].loser);
    }
    losers.insert(f.merges[i].loser);
  }
  // Keyframes that see a group, each through one keypoint only.
  std::map<LandmarkId, std::set<KeyframeId>> seen;
  const auto see = [&](LandmarkId group, KeyframeId by) {
    ASSERT_TRUE(seen[group].insert(by).second) << "two landmarks of one keyframe joined";
  };
  const auto see_all = [&](LandmarkId group, LandmarkId l) {
    for (const map::Observation& o : m.landmark(l).observations) see(group, o.keyframe);
  };
  for (const map::LandmarkMerge& merge : f.merges) {
    ASSERT_FALSE(losers.contains(merge.winner));
    ASSERT_LT(merge.winner, merge.loser);
    if (!seen.contains(merge.winner)) see_all(merge.winner, merge.winner);
    see_all(merge.winner, merge.loser);
  }
  for (std::size_t i = 0; i < f.observations.size(); ++i) {
    const map::NewObservation& o = f.observations[i];
    if (i > 0) {
      ASSERT_LT(std::pair(f.observations[i - 1].keyframe, f.observations[i - 1].keypoint),
                std::pair(o.keyframe, o.keypoint));
    }
    ASSERT_FALSE(losers.contains(o.landmark));
    ASSERT_FALSE(m.keyframe(o.keyframe).landmarks[o.keypoint].valid());
    if (!seen.contains(o.landmark)) see_all(o.landmark, o.landmark);
    see(o.landmark, o.keyframe);
  }
}

/// New connections, told from the map before and after the fusion was applied.
std::vector<map::LoopConnection> counted_anew(const Map& before, const Map& after,
                                              std::span<const KeyframeId> connected, int min) {
  std::set<KeyframeId> inside(connected.begin(), connected.end());
  std::vector<map::LoopConnection> found;
  for (const KeyframeId a : inside)
    for (std::uint32_t i = 0; i < after.keyframe_slots(); ++i) {
      const KeyframeId b(i);
      if (inside.contains(b) || before.num_shared(a, b) >= min) continue;
      if (const int shared = after.num_shared(a, b); shared >= min) found.push_back({a, b, shared});
    }
  return found;
}

void expect_equal(const std::vector<map::LoopConnection>& a,
                  const std::vector<map::LoopConnection>& b) {
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    EXPECT_EQ(a[i].a, b[i].a);
    EXPECT_EQ(a[i].b, b[i].b);
    EXPECT_EQ(a[i].shared, b[i].shared);
  }
}

TEST(LoopFusion, AllBackEndsAlikeFromSearchToCovisibility) {
  std::size_t merges = 0, observations = 0, connections = 0, contradicted = 0;
  for (unsigned seed = 0; seed < 260; ++seed) {
    SCOPED_TRACE(seed);
    const LoopMap loop(seed, map::testing::loop_map_options(seed));
    const Problem p = problem_of(loop, seed);
    const Map& before = loop.map();
    const Fusion reference = fuse_loop_reference(before, p.options, p.match, p.moved, p.cloud);
    const Fusion cpu = fuse_loop(Executor::cpu(), before, p.options, p.match, p.moved, p.cloud);
    for (const Executor& executor : fastloop::testing::all_executors())
      ASSERT_TRUE(reference ==
                  fuse_loop(executor, before, p.options, p.match, p.moved, p.cloud));
    expect_sound(before, cpu);

    Map one_by_one(before), at_once(before);
    const auto a = one_by_one.fuse_landmarks(Executor::reference(), cpu.merges, cpu.observations);
    const auto b = at_once.fuse_landmarks(Executor::cpu(), cpu.merges, cpu.observations);
    // What was found sound is taken as it is.
    EXPECT_EQ(a.merged, cpu.merges.size());
    EXPECT_EQ(a.observed, cpu.observations.size());
    EXPECT_EQ(b.merged, a.merged);
    EXPECT_EQ(b.observed, a.observed);
    map::testing::expect_same_landmarks(one_by_one, at_once);
    EXPECT_EQ(at_once.find_inconsistency(), std::nullopt);

    std::vector<KeyframeId> connected;
    for (const MovedKeyframe& k : p.moved) connected.push_back(k.keyframe);
    for (const int min : {1, 5, 15}) {
      const auto quick = find_connections(before, connected, cpu, min);
      expect_equal(quick, find_connections_reference(before, connected, cpu, min));
      expect_equal(quick, counted_anew(before, at_once, connected, min));
      connections += quick.size();
    }
    merges += cpu.merges.size();
    observations += cpu.observations.size();
    contradicted += seed % 4 == 2;
  }
  EXPECT_GT(merges, 1000u);
  EXPECT_GT(observations, 500u);
  EXPECT_GT(connections, 200u);
  EXPECT_GT(contradicted, 50u);
}

TEST(LoopFusion, JoinsWhatShowsTheSamePoint) {
  for (const bool fisheye : {false, true}) {
    LoopMapOptions o;
    o.points = 250;
    o.fisheye = fisheye;
    o.T_drift = SE3(so3::exp({0, 0, 0.03}), Vector3d(1, -0.5, 0.1));
    const LoopMap loop(7, o);
    Problem p = problem_of(loop, 7);
    p.match.landmarks.assign(p.match.landmarks.size(), LandmarkId{});
    const Fusion f = fuse_loop(Executor::cpu(), loop.map(), p.options, p.match, p.moved, p.cloud);
    EXPECT_GT(f.merges.size(), 20u);
    for (const map::LandmarkMerge& m : f.merges)
      EXPECT_EQ(loop.point_of[m.loser.value()], loop.point_of[m.winner.value()]);
    EXPECT_GT(f.observations.size(), 10u);
    for (const map::NewObservation& n : f.observations)
      EXPECT_EQ(loop.point_of[n.landmark.value()],
                loop.made.views[n.keyframe.value()].point[n.keypoint]);
  }
}

/// One keyframe on either side, and of all that the early one knows only what a test leaves.
class OnePointFusion : public ::testing::TestWithParam<bool> {
 protected:
  OnePointFusion() {
    LoopMapOptions o;
    o.points = 120;
    o.early = o.late = 1;
    o.landmark_share = 1;
    o.fisheye = GetParam();
    loop_ = std::make_unique<LoopMap>(11, o);
    const Map& m = loop_->map();
    const KeyframeId late = loop_->late[0];
    moved_.push_back({late, loop_->true_camera(late)});
    cloud_ = map::LandmarkArrays(m, map::landmarks_of(m, loop_->early));
    match_.current = late;
    match_.matched = loop_->early[0];
    match_.landmarks.assign(m.keyframe(late).landmarks.size(), LandmarkId{});
  }
  std::size_t merges() const {
    const Fusion a = fuse_loop(Executor::cpu(), loop_->map(), options_, match_, moved_, cloud_);
    const Fusion b = fuse_loop_reference(loop_->map(), options_, match_, moved_, cloud_);
    EXPECT_TRUE(a == b);
    return a.merges.size();
  }
  std::unique_ptr<LoopMap> loop_;
  LoopOptions options_;
  RegionMatch match_;
  std::vector<MovedKeyframe> moved_;
  map::LandmarkArrays cloud_;
};
INSTANTIATE_TEST_SUITE_P(BothCameras, OnePointFusion, ::testing::Bool());

TEST_P(OnePointFusion, RadiusAndDistance) {
  // One landmark and the nearest of the late keyframe's keypoints that it may take.
  const auto found = search_keyframes(Executor::cpu(), loop_->map(), moved_, cloud_, 4, 50).front();
  const auto it = std::find_if(found.keypoint.begin(), found.keypoint.end(),
                               [](auto k) { return k != matching::kNoMatch; });
  ASSERT_NE(it, found.keypoint.end());
  const auto i = static_cast<std::size_t>(it - found.keypoint.begin());
  const LandmarkId only = cloud_.ids[i];
  cloud_ = map::LandmarkArrays(loop_->map(), {only});
  EXPECT_EQ(merges(), 1u);
  options_.fusion_max_distance = found.distance[i];
  EXPECT_EQ(merges(), 1u);
  options_.fusion_max_distance = found.distance[i] - 1;
  EXPECT_EQ(merges(), 0u);
  options_.fusion_max_distance = 50;

  const FeatureSet& f = *loop_->map().keyframe(loop_->late[0]).data->features;
  const Camera& camera = loop_->world.rig.left;
  const Vector3d p = moved_[0].T_camera_world * cloud_.p_world[0].cast<double>();
  const Eigen::Vector2d off =
      camera.project(p) -
      Eigen::Vector2d(f.x[static_cast<std::size_t>(*it)], f.y[static_cast<std::size_t>(*it)]);
  const double level = std::ceil(std::log(cloud_.max_distance_m[0] / p.norm()) / std::log(1.2));
  const double needed = off.cwiseAbs().maxCoeff() / std::pow(1.2, std::clamp(level, 0.0, 7.0));
  options_.fusion_radius_px = static_cast<float>(needed + 0.002);
  EXPECT_EQ(merges(), 1u);
  options_.fusion_radius_px = static_cast<float>(needed - 0.002);
  EXPECT_EQ(merges(), 0u);
}

TEST(Connections, ThresholdOfSharedLandmarks) {
  LoopMapOptions o;
  o.points = 200;
  o.early = o.late = 1;
  o.landmark_share = 1;
  const LoopMap loop(3, o);
  Problem p = problem_of(loop, 1);
  const Fusion f = fuse_loop(Executor::cpu(), loop.map(), p.options, p.match, p.moved, p.cloud);
  const int shared = static_cast<int>(f.merges.size() + f.observations.size());
  ASSERT_GT(shared, 15);
  for (const auto find : {find_connections, find_connections_reference}) {
    const auto at = find(loop.map(), loop.late, f, shared);
    ASSERT_EQ(at.size(), 1u);
    EXPECT_EQ(at[0].shared, shared);
    EXPECT_TRUE(find(loop.map(), loop.late, f, shared + 1).empty());
  }
}

}  // namespace
}  // namespace fastloop::loop
