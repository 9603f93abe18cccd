#include "fastloop/loop/keyframe_search.hpp"

#include <gtest/gtest.h>

#include "fastloop/compute/executors_for_tests.hpp"
#include "fastloop/map/loop_map_for_tests.hpp"
#include "fastloop/matching/expectations_for_tests.hpp"

/// The search of loop closing on maps: all executors alike, and its rule at every threshold. The
/// primitive below is held against brute force in matching/projection_search_test.cpp.
namespace fastloop::loop {
namespace {

using map::testing::LoopMap;
using map::testing::LoopMapOptions;
using matching::kNoMatch;
using matching::ProjectionMatches;

std::vector<ProjectionMatches> expect_parity(const map::Snapshot& m,
                                             std::span<const MovedKeyframe> moved,
                                             const map::LandmarkArrays& cloud, float radius_px,
                                             int max_distance) {
  const auto reference =
      search_keyframes(Executor::reference(), m, moved, cloud, radius_px, max_distance);
  EXPECT_EQ(reference.size(), moved.size());
  for (const Executor& executor : fastloop::testing::parallel_executors()) {
    const auto other = search_keyframes(executor, m, moved, cloud, radius_px, max_distance);
    EXPECT_EQ(other.size(), moved.size());
    for (std::size_t t = 0; t < reference.size(); ++t)
      matching::testing::expect_equal(reference[t], other[t]);
  }
  return reference;
}

TEST(KeyframeSearch, AllExecutorsAlike) {
  int situations = 0, matches = 0, crowded = 0, behind = 0;
  for (unsigned seed = 0; seed < 240; ++seed) {
    SCOPED_TRACE(seed);
    const LoopMapOptions o = map::testing::loop_map_options(seed);
    const LoopMap loop(seed, o);
    const map::Map& m = loop.map();
    std::mt19937 rng(seed);
    std::vector<MovedKeyframe> moved;
    for (const KeyframeId id : loop.late) {
      SE3 T = loop.true_camera(id);
      if (seed % 12 == 1) {  // everything lies behind
        T = SE3(so3::exp({0, M_PI, 0}), Vector3d::Zero()) * T;
        ++behind;
      }
      moved.push_back({id, T});
    }
    if (seed % 20 == 7) moved.clear();
    std::vector<LandmarkId> ids = map::landmarks_of(m, loop.early);
    if (seed % 20 == 8) ids.clear();
    if (seed % 20 == 9) ids.resize(std::min<std::size_t>(1, ids.size()));
    static constexpr float kRadius[] = {8, 5, 3, 4, 30};
    static constexpr int kDistance[] = {75, 50, 75, 50, 255};
    for (const auto& r : expect_parity(m, moved, map::LandmarkArrays(m, ids), kRadius[rng() % 5],
                                       kDistance[rng() % 5]))
      matches += r.count;
    ++situations;
    crowded += o.crowded && o.points >= 150;
  }
  EXPECT_GE(situations, 200);
  EXPECT_GT(matches, 2000);
  EXPECT_GT(crowded, 5);
  EXPECT_GT(behind, 20);
}

TEST(KeyframeSearch, FiveThousandLandmarksInSixtyKeyframes) {
  for (const bool fisheye : {false, true}) {
    map::testing::SyntheticWorld world(9000, Vector3d(6, 4, 3), 5);
    if (fisheye) {
      const SE3 T_body_left = world.rig.T_body_left;
      world.rig = matching::testing::fisheye_rig();
      world.rig.T_body_left = T_body_left;
    }
    map::testing::ViewOptions view;
    view.stereo_share = fisheye ? 0 : 0.7;
    std::mt19937 rng(6);
    map::testing::SyntheticMap made(world);
    for (int i = 0; i < 8; ++i)  // all around
      made.add(map::testing::pose_at({0, 0, 0}, i * M_PI / 4), view, rng);
    std::vector<LandmarkId> ids;
    for (const LandmarkId l : made.landmark_of)
      if (l.valid() && ids.size() < 5000) ids.push_back(l);
    ASSERT_EQ(ids.size(), 5000u);
    // Landmarks of their own would take most of the time and change nothing.
    std::vector<MovedKeyframe> moved;
    for (int i = 0; i < 60; ++i) {
      const SE3 T = map::testing::pose_at(map::testing::normal_vector(rng, 0.3), 0.1 * i);
      const KeyframeId k = made.add(T, view, rng, 0);
      moved.push_back({k, (T * world.rig.T_body_left).inverse()});
    }
    int matches = 0;
    for (const auto& r : expect_parity(made.map, moved, map::LandmarkArrays(made.map, ids), 8, 75))
      matches += r.count;
    EXPECT_GT(matches, 60 * 300) << fisheye;
  }
}

/// One landmark and one keyframe with one keypoint, which the test puts where it likes.
class OneLandmarkOneKeyframe : public ::testing::TestWithParam<bool> {
 protected:
  OneLandmarkOneKeyframe() {
    if (GetParam()) rig_ = matching::testing::fisheye_rig();
    std::mt19937 rng(2);
    look_ = matching::testing::random_descriptor(rng);
  }
  /// Whether the landmark is found at a keypoint `bits` away in looks and (dx, dy) pixels away from
  /// its projection.
  bool finds(double dx, double dy, int octave, int bits) {
    map::Map m(rig_, PyramidScales());
    const MapId id = m.start_map();
    const auto add = [&](const Vector3d& centre, const Eigen::Vector2d& pixel, int at_octave,
                         const Descriptor& look) {
      map::testing::SyntheticView view;
      map::testing::add_keypoint(view, pixel, NAN, 0, at_octave, look, 0);
      map::testing::finish(view, rig_.left);
      NavState state;
      state.T_world_body.translation = centre;
      return m.add_keyframe(id, map::testing::keyframe_data(view, FrameId(0), 0), state, nullptr);
    };
    // A landmark first seen at octave 0 can be that far away, and looked at from there.
    const KeyframeId creator = add(p_camera_ - max_m_ * normal_, {100, 100}, 0, look_);
    const LandmarkId l = m.add_landmark(creator, 0, p_camera_);
    Descriptor look = look_;
    for (int b = 0; b < bits; ++b) look.words[b / 64] ^= std::uint64_t{1} << (b % 64);
    const Eigen::Vector2d pixel = rig_.left.project(p_camera_) + Eigen::Vector2d(dx, dy);
    const MovedKeyframe one{add({0, 0, 0}, pixel, octave, look), SE3()};
    const map::LandmarkArrays cloud(m, {l});
    EXPECT_NEAR(cloud.max_distance_m[0], max_m_, 1e-5);
    EXPECT_LT((cloud.normal_world[0].cast<double>() - normal_).norm(), 1e-5);
    return expect_parity(m, {&one, 1}, cloud, radius_px_, max_distance_).front().count == 1;
  }

  StereoRig rig_ = matching::testing::pinhole_rig();
  Descriptor look_;
  Vector3d p_camera_{0.3, -0.2, 4}, normal_ = Vector3d(0.3, -0.2, 4).normalized();
  double max_m_ = 4.2;  ///< level 1 at 4.02 m
  float radius_px_ = 8;
  int max_distance_ = 75;
};
INSTANTIATE_TEST_SUITE_P(BothCameras, OneLandmarkOneKeyframe, ::testing::Bool());

TEST_P(OneLandmarkOneKeyframe, RadiiAndDistancesOfEverySearch) {
  struct Rule {
    const char* name;
    float radius_px;
    int max_distance;
  };
  for (const Rule& rule :
       {Rule{"PS2a", 8, 75}, {"PS2b", 5, 50}, {"PS1, PS3", 3, 75}, {"fusion", 4, 50}}) {
    SCOPED_TRACE(rule.name);
    radius_px_ = rule.radius_px;
    max_distance_ = rule.max_distance;
    const double r = 1.2 * rule.radius_px;
    for (const double sign : {-1.0, 1.0}) {
      EXPECT_TRUE(finds(sign * (r - 0.01), 0, 1, 0));
      EXPECT_FALSE(finds(sign * (r + 0.01), 0, 1, 0));
      EXPECT_TRUE(finds(0, sign * (r - 0.01), 1, 0));
      EXPECT_FALSE(finds(0, sign * (r + 0.01), 1, 0));
    }
    EXPECT_TRUE(finds(0, 0, 1, rule.max_distance));
    EXPECT_FALSE(finds(0, 0, 1, rule.max_distance + 1));
  }
}

TEST_P(OneLandmarkOneKeyframe, OctavesOneBelowToThePredictedOne) {
  for (int octave = 0; octave < 4; ++octave)
    EXPECT_EQ(finds(0, 0, octave, 0), octave <= 1) << octave;
  max_m_ = 4.2 * std::pow(1.2, 3);
  for (int octave = 0; octave < 8; ++octave)
    EXPECT_EQ(finds(0, 0, octave, 0), octave == 3 || octave == 4) << octave;
}

TEST_P(OneLandmarkOneKeyframe, DistanceRange) {
  const double distance = p_camera_.norm(), range = std::pow(1.2, 7);
  for (const auto& [factor, inside] : {std::pair{1.2 - 1e-3, true}, {1.2 + 1e-3, false}}) {
    max_m_ = distance / factor;
    EXPECT_EQ(finds(0, 0, 0, 0), inside) << factor;
  }
  for (const auto& [factor, inside] : {std::pair{0.8 + 1e-3, true}, {0.8 - 1e-3, false}}) {
    max_m_ = range * distance / factor;
    EXPECT_EQ(finds(0, 0, 7, 0), inside) << factor;
  }
}

TEST_P(OneLandmarkOneKeyframe, ViewingAngleOfSixtyDegrees) {
  for (const double off : {-0.001, 0.001}) {
    normal_ = so3::exp((M_PI / 3 + off) * p_camera_.unitOrthogonal()) * p_camera_.normalized();
    EXPECT_EQ(finds(0, 0, 1, 0), off < 0);
  }
}

TEST_P(OneLandmarkOneKeyframe, BehindTheCamera) {
  EXPECT_TRUE(finds(0, 0, 1, 0));
  p_camera_ = Vector3d(0, 0, -4.02);
  normal_ = p_camera_.normalized();
  EXPECT_FALSE(finds(100, 100, 1, 0));
}

}  // namespace
}  // namespace fastloop::loop
