#include <gtest/gtest.h>

#include <limits>

#include "fastloop/matching/expectations_for_tests.hpp"
#include "fastloop/matching/projection_search.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::add_keypoint;
using testing::expect_equal;
using testing::finish;
using testing::run;
using testing::Scene;

/// One camera at the origin, one landmark ahead at 4 m (level 0 up to 4 m), keypoints as the test
/// says.
class OneLandmark : public ::testing::TestWithParam<bool> {
 protected:
  OneLandmark() {
    scene_.rig = GetParam() ? testing::fisheye_rig() : testing::pinhole_rig();
    std::mt19937 rng(3);
    descriptor_ = testing::random_descriptor(rng);
    set_landmark({0.3, -0.2, 4});
    scene_.features.resize(1);
    scene_.T_camera_world.resize(1);
    scene_.scale = {1};
    scene_.blocked.resize(1);
    scene_.skipped.resize(1);
    options_.radius_px = 3;
  }

  void set_landmark(const Vector3d& p) {
    scene_.landmarks = {};
    // Seen from 4.2 m at level 0: predicted level 1 at |p| = 4.02.
    scene_.landmarks.add(p, p.normalized(), 1.2, 4.2, descriptor_);
    pixel_ = scene_.rig.left.project(p);
    p_ = p;
  }
  Descriptor flipped(int bits) const {
    Descriptor d = descriptor_;
    for (int b = 0; b < bits; ++b) d.words[b / 64] ^= std::uint64_t{1} << (b % 64);
    return d;
  }
  void add(double dx, double dy, int octave = 1, int bits = 0, double right_x = NAN,
           double right_y = NAN) {
    add_keypoint(scene_.features[0], pixel_.x() + dx, pixel_.y() + dy, octave, flipped(bits), 0,
                 right_x, right_y);
  }
  /// Keypoint of the landmark; both executors must say the same.
  int match() {
    finish(scene_.features[0], scene_.rig.left);
    const auto reference = run(Executor::reference(), scene_, options_);
    const auto cpu = run(Executor::cpu(), scene_, options_);
    expect_equal(reference[0], cpu[0]);
    in_view_ = reference[0].in_view[0];
    return reference[0].keypoint[0];
  }
  int match_single(double dx, double dy, int octave = 1, int bits = 0, double right_x = NAN,
                   double right_y = NAN) {
    scene_.features[0] = FeatureSet();
    add(dx, dy, octave, bits, right_x, right_y);
    return match();
  }

  Scene scene_;
  Descriptor descriptor_;
  Eigen::Vector2d pixel_;
  Vector3d p_;
  ProjectionSearchOptions options_;
  bool in_view_ = false;
};
INSTANTIATE_TEST_SUITE_P(BothCameras, OneLandmark, ::testing::Bool());

TEST_P(OneLandmark, WindowIsASquareScaledByTheLevel) {
  const double r = 3 * 1.2;  // level 1
  for (const auto& [x, y] : {std::pair{1, 0}, {-1, 0}, {0, 1}, {0, -1}, {1, 1}, {-1, 1}}) {
    EXPECT_EQ(match_single(x * (r - 0.01), y * (r - 0.01)), 0);
    EXPECT_EQ(match_single(x * (r + 0.01), y * (r + 0.01)), kNoMatch);
    EXPECT_TRUE(in_view_);
  }
}

TEST_P(OneLandmark, DescriptorThreshold) {
  EXPECT_EQ(match_single(0, 0, 1, 75), 0);
  EXPECT_EQ(match_single(0, 0, 1, 76), kNoMatch);
}

TEST_P(OneLandmark, OctaveRange) {
  const auto accepted = [&] {
    std::vector<int> octaves;
    for (int o = 0; o < 8; ++o)
      if (match_single(0, 0, o) == 0) octaves.push_back(o);
    return octaves;
  };
  EXPECT_EQ(accepted(), (std::vector{0, 1}));
  options_.octaves_above = 1;
  EXPECT_EQ(accepted(), (std::vector{0, 1, 2}));
  options_.octaves_below = 0;
  EXPECT_EQ(accepted(), (std::vector{1, 2}));
}

TEST_P(OneLandmark, LevelChangesWhereTheDistanceRatioPassesAPower) {
  options_.octaves_below = 0;
  const auto level = [&] {
    for (int o = 0; o < 8; ++o)
      if (match_single(0, 0, o) == 0) return o;
    return -1;
  };
  for (int l = 0; l < 5; ++l) {
    set_landmark(Vector3d(0.05, 0.02, 1).normalized() * 4.2 / std::pow(1.2, l) * 1.0001);
    EXPECT_EQ(level(), l);
    set_landmark(Vector3d(0.05, 0.02, 1).normalized() * 4.2 / std::pow(1.2, l) * 0.9999);
    EXPECT_EQ(level(), l + 1);
  }
}

TEST_P(OneLandmark, DistanceRange) {
  const Vector3d ray = Vector3d(0.1, 0.1, 1).normalized();
  for (const auto& [metres, expected] : {std::pair{0.8 * 1.2 + 1e-4, true},
                                         {0.8 * 1.2 - 1e-4, false},
                                         {1.2 * 4.2 - 1e-4, true},
                                         {1.2 * 4.2 + 1e-4, false}}) {
    set_landmark(metres * ray);
    match_single(0, 0);
    EXPECT_EQ(in_view_, expected) << metres;
  }
}

TEST_P(OneLandmark, ViewingAngle) {
  const Vector3d axis = p_.unitOrthogonal();
  for (const double off : {-0.001, 0.001}) {
    const double angle = M_PI / 3 + off;  // cos = 0.5
    scene_.landmarks.normal_world[0] = (so3::exp(angle * axis) * p_.normalized()).cast<float>();
    EXPECT_EQ(match_single(0, 0), off < 0 ? 0 : kNoMatch);
    EXPECT_EQ(in_view_, off < 0);
  }
  options_.min_view_cos = -1;
  EXPECT_EQ(match_single(0, 0), 0);
}

TEST_P(OneLandmark, WideViewsGetALargerWindow) {
  options_.wide_view_cos = 0.9f;
  options_.wide_factor = 2;
  EXPECT_EQ(match_single(5, 0), kNoMatch);
  scene_.landmarks.normal_world[0] =
      (so3::exp((std::acos(0.9) + 0.001) * p_.unitOrthogonal()) * p_.normalized()).cast<float>();
  EXPECT_EQ(match_single(5, 0), 0);
  scene_.landmarks.normal_world[0] =
      (so3::exp((std::acos(0.9) - 0.001) * p_.unitOrthogonal()) * p_.normalized()).cast<float>();
  EXPECT_EQ(match_single(5, 0), kNoMatch);
}

TEST_P(OneLandmark, ImageBounds) {
  const Camera& camera = scene_.rig.left;
  for (const auto& [x, y, inside] : {std::tuple{0.02, 200.0, true},
                                     {-0.02, 200.0, false},
                                     {200.0, 0.02, true},
                                     {200.0, -0.02, false},
                                     {camera.width - 1.02, 200.0, true},
                                     {camera.width - 0.98, 200.0, false},
                                     {200.0, camera.height - 1.02, true},
                                     {200.0, camera.height - 0.98, false}}) {
    set_landmark(4 * camera.unproject({x, y}));
    match_single(0, 0);
    EXPECT_EQ(in_view_, inside) << x << " " << y;
  }
}

TEST_P(OneLandmark, BehindTheCameraAndNotFinite) {
  set_landmark({0.3, -0.2, -4});
  match_single(0, 0);
  EXPECT_FALSE(in_view_);
  set_landmark({0, 0, 0});
  match_single(0, 0);
  EXPECT_FALSE(in_view_);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  set_landmark({0.3, -0.2, 4});
  for (float* value : {&scene_.landmarks.p_world[0].x(), &scene_.landmarks.normal_world[0].y(),
                       &scene_.landmarks.min_distance_m[0], &scene_.landmarks.max_distance_m[0]}) {
    const float before = *value;
    *value = nan;
    EXPECT_EQ(match_single(0, 0), kNoMatch);
    EXPECT_FALSE(in_view_);
    *value = before;
  }
  EXPECT_EQ(match_single(0, 0), 0);
}

TEST_P(OneLandmark, RatioTestComparesKeypointsOfOneOctave) {
  options_.best_to_second = 0.8f;
  const auto two = [&](int best, int second, int second_octave) {
    scene_.features[0] = FeatureSet();
    add(0.5, 0, 1, best);
    add(-0.5, 0, second_octave, second);
    return match();
  };
  EXPECT_EQ(two(40, 50, 1), 0);
  EXPECT_EQ(two(41, 50, 1), kNoMatch);
  EXPECT_EQ(two(41, 50, 0), 0);
  EXPECT_EQ(two(50, 50, 1), kNoMatch);
  options_.best_to_second = 1;
  EXPECT_EQ(two(50, 50, 1), 0);
}

TEST_P(OneLandmark, TiesTakeTheLowerKeypoint) {
  // The second keypoint lies in an earlier cell of the grid.
  add(2, 2, 1, 10);
  add(-2, -2, 1, 10);
  EXPECT_EQ(match(), 0);
}

TEST_P(OneLandmark, BlockedAndSkipped) {
  add(0, 0, 1, 0);
  add(1, 0, 1, 20);
  scene_.blocked[0] = {1, 0};
  EXPECT_EQ(match(), 1);
  scene_.blocked[0] = {1, 1};
  EXPECT_EQ(match(), kNoMatch);
  EXPECT_TRUE(in_view_);
  scene_.blocked[0] = {};
  scene_.skipped[0] = {1};
  EXPECT_EQ(match(), kNoMatch);
  EXPECT_FALSE(in_view_);
}

TEST_P(OneLandmark, ReprojectionGates) {
  const Vector3d p_right = scene_.rig.T_right_left * p_;
  const Eigen::Vector2d right = scene_.rig.right.project(p_right);
  const double sigma2 = 1.44;
  options_.chi2_gate_mono = 5.991f;
  options_.radius_px = 10;
  const double edge = std::sqrt(5.991 * sigma2);
  EXPECT_EQ(match_single(edge - 0.01, 0), 0);
  EXPECT_EQ(match_single(edge + 0.01, 0), kNoMatch);
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x() + 50, right.y()), 0);
  options_.chi2_gate_stereo = 7.815f;
  const double stereo_edge = std::sqrt(7.815 * sigma2);
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x() + stereo_edge - 0.01, right.y()), 0);
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x() + stereo_edge + 0.01, right.y()), kNoMatch);
  // Rows differ freely only where the rig is rectified, for there they are equal by construction.
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x(), right.y() + stereo_edge + 0.01),
            GetParam() ? kNoMatch : 0);
  EXPECT_EQ(match_single(edge + 0.01, 0),
            kNoMatch);  // no right coordinate: the gate of two numbers
}

TEST_P(OneLandmark, RightCoordinateWindow) {
  const Eigen::Vector2d right = scene_.rig.right.project(scene_.rig.T_right_left * p_);
  const double r = 3 * 1.2;
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x() + r + 0.01, right.y()), 0);
  options_.check_right = true;
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x() + r - 0.01, right.y()), 0);
  EXPECT_EQ(match_single(0, 0, 1, 0, right.x() + r + 0.01, right.y()), kNoMatch);
  EXPECT_EQ(match_single(0, 0), 0);
}

TEST_P(OneLandmark, OneKeypointGoesToTheNearestThenTheFirstLandmark) {
  const auto landmark = [&](int bits) {
    scene_.landmarks.add(p_, p_.normalized(), 1.2, 4.2, flipped(bits));
  };
  scene_.landmarks = {};
  for (const int bits : {30, 20, 20, 40}) landmark(bits);
  add(0, 0, 1, 0);
  finish(scene_.features[0], scene_.rig.left);
  const auto results = run(Executor::cpu(), scene_, options_);
  EXPECT_EQ(results[0].keypoint, (std::vector{kNoMatch, 0, kNoMatch, kNoMatch}));
  EXPECT_EQ(results[0].distance, (std::vector<std::uint16_t>{0, 20, 0, 0}));
  EXPECT_EQ(results[0].count, 1);
}

TEST_P(OneLandmark, FullCellsHaveNoLimit) {
  for (int i = 0; i < 150; ++i) add(0.01 * (i % 15), 0.01 * (i / 15), 1, 60 - i % 50);
  add(0, 0, 1, 5);
  EXPECT_EQ(match(), 150);
}

TEST_P(OneLandmark, ScaleOfASimilarityDoesNotMoveTheProjection) {
  scene_.scale = {1.7};
  EXPECT_EQ(match_single(0, 0), 0);
  EXPECT_TRUE(in_view_);
}

TEST_P(OneLandmark, FarFromTheOriginIsAsGoodAsNear) {
  // 3 km away the landmarks themselves are rounded to 0.1 mm.
  const Vector3d shift(3000, -2000, 50);
  scene_.landmarks.p_world[0] = (p_ + shift).cast<float>();
  scene_.T_camera_world[0].translation = -shift;
  EXPECT_EQ(match_single(3.5, 3.5), 0);
  EXPECT_EQ(match_single(3.7, 0), kNoMatch);
}

}  // namespace
}  // namespace fastloop::matching
