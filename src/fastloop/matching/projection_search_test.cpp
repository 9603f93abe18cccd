#include "fastloop/matching/projection_search.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::add_keypoint;
using testing::finish;
using testing::random_scene;
using testing::Scene;
using testing::SceneSize;

/// The search written again, in double precision, over all keypoints, from the text of the header.
/// `near_edge` reports decisions so close to a threshold that float and double may differ.
class Oracle {
 public:
  Oracle(const Scene& scene, const ProjectionSearchOptions& options) : s_(scene), o_(options) {}

  ProjectionMatches search(const SearchTarget& target, std::vector<std::uint8_t>* near_edge) {
    const std::size_t n = s_.landmarks.p_world.size();
    ProjectionMatches result;
    result.keypoint.assign(n, kNoMatch);
    result.distance.assign(n, 0);
    result.in_view.assign(n, 0);
    near_edge->assign(n, 0);
    std::vector<std::pair<int, int>> claim(n, {kNoMatch, 0});  // keypoint, distance
    for (std::size_t i = 0; i < n; ++i) {
      near_edge_ = false;
      if (target.landmark_skipped.empty() || !target.landmark_skipped[i]) {
        in_view_ = false;
        claim[i] = best(target, i);
        result.in_view[i] = in_view_;
      }
      (*near_edge)[i] = near_edge_;
    }
    for (std::size_t k = 0; k < target.features->size(); ++k) {
      int winner = -1;
      for (std::size_t i = 0; i < n; ++i)
        if (claim[i].first == static_cast<int>(k) &&
            (winner < 0 || claim[i].second < claim[winner].second))
          winner = static_cast<int>(i);
      if (winner < 0) continue;
      result.keypoint[winner] = static_cast<int>(k);
      result.distance[winner] = static_cast<std::uint16_t>(claim[winner].second);
      ++result.count;
    }
    return result;
  }

 private:
  bool less_equal(double a, double b) {
    if (std::abs(a - b) < 1e-3 * std::max(1.0, std::abs(b)) * tolerance_) near_edge_ = true;
    return a <= b;
  }

  std::pair<int, int> best(const SearchTarget& target, std::size_t i) {
    const Vector3d p_world = s_.landmarks.p_world[i].cast<double>();
    const Vector3d ray = p_world - target.T_camera_world.inverse().translation;
    const double distance = ray.norm();
    const Vector3d p = target.scale * (target.T_camera_world * p_world);
    const Camera& camera = s_.rig.left;
    tolerance_ = 1e-2;
    if (camera.model == CameraModel::kPinhole && less_equal(p.z(), 0)) return {kNoMatch, 0};
    if (!camera.is_projectable(p)) return {kNoMatch, 0};
    tolerance_ = 1;
    const Eigen::Vector2d pixel = camera.project(p);
    if (!less_equal(0, pixel.x()) || !less_equal(0, pixel.y()) ||
        !less_equal(pixel.x(), camera.width - 1) || !less_equal(pixel.y(), camera.height - 1))
      return {kNoMatch, 0};
    tolerance_ = 1e-2;
    const double farthest = s_.landmarks.max_distance_m[i];
    if (!less_equal(o_.min_distance_factor * s_.landmarks.min_distance_m[i], distance) ||
        !less_equal(distance, o_.max_distance_factor * farthest))
      return {kNoMatch, 0};
    const double cosine = ray.dot(s_.landmarks.normal_world[i].cast<double>()) / distance;
    if (o_.min_view_cos > -1 && !less_equal(o_.min_view_cos, cosine)) return {kNoMatch, 0};
    in_view_ = true;

    const double level_real = std::log(farthest / distance) / std::log(1.2);
    if (std::abs(level_real - std::round(level_real)) < 1e-4) near_edge_ = true;
    const int level = std::clamp(static_cast<int>(std::ceil(level_real)), 0, s_.scales.levels - 1);
    double radius = o_.radius_px * std::pow(1.2, level);
    if (!less_equal(o_.wide_view_cos, cosine)) radius *= o_.wide_factor;
    tolerance_ = 1;
    return best_keypoint(target, i, p, pixel, level, radius);
  }

  bool accepts(const FeatureSet& f, int k, const Vector3d& p, const Eigen::Vector2d& pixel,
               double radius) {
    const double dx = f.x[k] - pixel.x(), dy = f.y[k] - pixel.y();
    if (!less_equal(std::abs(dx), radius) || !less_equal(std::abs(dy), radius)) return false;
    const bool stereo = !std::isnan(f.right_x[k]);
    Eigen::Vector2d right(pixel.x() - s_.rig.left.fx * s_.rig.baseline_m / p.z(), f.right_y[k]);
    if (s_.rig.kind == StereoRig::Kind::kGeneral)
      right = s_.rig.right.project(s_.rig.T_right_left * p);
    const double du = f.right_x[k] - right.x(), dv = f.right_y[k] - right.y();
    if (o_.check_right && stereo && !less_equal(std::abs(du), radius)) return false;
    const double sigma2 = std::pow(1.2, 2 * f.octave[k]);
    double error2 = dx * dx + dy * dy;
    if (stereo && o_.chi2_gate_stereo > 0) {
      error2 += du * du;
      if (s_.rig.kind == StereoRig::Kind::kGeneral) error2 += dv * dv;
      return less_equal(error2 / sigma2, o_.chi2_gate_stereo);
    }
    return o_.chi2_gate_mono <= 0 || less_equal(error2 / sigma2, o_.chi2_gate_mono);
  }

  std::pair<int, int> best_keypoint(const SearchTarget& target, std::size_t i, const Vector3d& p,
                                    const Eigen::Vector2d& pixel, int level, double radius) {
    const FeatureSet& f = *target.features;
    int best = kNoMatch, best_distance = 1000, second = kNoMatch, second_distance = 1000;
    for (int k = 0; k < static_cast<int>(f.size()); ++k) {
      if (!target.keypoint_blocked.empty() && target.keypoint_blocked[k]) continue;
      if (f.octave[k] < level - o_.octaves_below || f.octave[k] > level + o_.octaves_above)
        continue;
      if (!accepts(f, k, p, pixel, radius)) continue;
      const int d = hamming_distance(s_.landmarks.descriptor[i], f.descriptors[k]);
      if (d < best_distance) {
        second = best, second_distance = best_distance;
        best = k, best_distance = d;
      } else if (d < second_distance) {
        second = k, second_distance = d;
      }
    }
    if (best == kNoMatch || best_distance > o_.max_distance) return {kNoMatch, 0};
    if (o_.best_to_second < 1 && second != kNoMatch && f.octave[best] == f.octave[second] &&
        best_distance > o_.best_to_second * second_distance)
      return {kNoMatch, 0};
    return {best, best_distance};
  }

  const Scene& s_;
  const ProjectionSearchOptions& o_;
  bool near_edge_ = false, in_view_ = false;
  double tolerance_ = 1;
};

std::vector<ProjectionMatches> run(const Executor& executor, const Scene& scene,
                                   const ProjectionSearchOptions& options) {
  const auto targets = scene.targets();
  std::vector<ProjectionMatches> results(targets.size());
  search_by_projection(executor, scene.rig, scene.scales, targets, scene.landmarks.view(), options,
                       results);
  return results;
}

void expect_equal(const ProjectionMatches& a, const ProjectionMatches& b) {
  EXPECT_EQ(a.keypoint, b.keypoint);
  EXPECT_EQ(a.distance, b.distance);
  EXPECT_EQ(a.in_view, b.in_view);
  EXPECT_EQ(a.count, b.count);
}

/// The rules in use: loop detection, fusion, tracking of the local map, duplicates among
/// neighbours.
ProjectionSearchOptions rule(int which) {
  ProjectionSearchOptions o;
  if (which == 1) o.radius_px = 8;
  if (which == 2) {
    o.radius_px = 4, o.max_distance = 100, o.best_to_second = 0.8f;
    o.min_distance_factor = 0.8f, o.octaves_above = 1;
    o.wide_view_cos = 0.9f, o.wide_factor = 1.6f, o.check_right = true;
  }
  if (which == 3)
    o.chi2_gate_mono = 5.99f, o.chi2_gate_stereo = 7.8f, o.min_view_cos = -1, o.octaves_above = 1;
  return o;
}

TEST(ProjectionSearch, EqualsBruteForceWithBothExecutorsAndBothCameras) {
  int matches = 0, situations = 0, left_out = 0, landmarks = 0;
  for (unsigned seed = 0; seed < 240; ++seed) {
    SceneSize size;
    size.landmarks = seed % 8 == 0 ? 1 : 20 + 7 * static_cast<int>(seed % 41);
    size.targets = 1 + static_cast<int>(seed % 3);
    size.crowding = seed % 5 == 0 ? 0.6 : 0;
    Scene scene = random_scene(seed, seed % 2 == 1, size);
    const ProjectionSearchOptions options = rule(static_cast<int>(seed / 2 % 4));
    Oracle oracle(scene, options);
    auto targets = scene.targets();
    // Landmarks on the edge of a decision are left out, for the oracle computes in double.
    for (std::size_t t = 0; t < targets.size(); ++t) {
      std::vector<std::uint8_t> near_edge;
      oracle.search(targets[t], &near_edge);
      scene.skipped[t].resize(near_edge.size());
      for (std::size_t i = 0; i < near_edge.size(); ++i) {
        scene.skipped[t][i] |= near_edge[i];
        left_out += near_edge[i];
        ++landmarks;
      }
    }
    targets = scene.targets();
    const auto reference = run(Executor::reference(), scene, options);
    const auto cpu = run(Executor::cpu(), scene, options);
    for (std::size_t t = 0; t < targets.size(); ++t) {
      SCOPED_TRACE(::testing::Message() << "seed " << seed << " target " << t);
      std::vector<std::uint8_t> near_edge;
      expect_equal(oracle.search(targets[t], &near_edge), reference[t]);
      expect_equal(reference[t], cpu[t]);
      matches += reference[t].count;
      ++situations;
    }
  }
  EXPECT_GE(situations, 200);
  EXPECT_GT(matches, 2000);
  EXPECT_LT(left_out, landmarks / 20);
}

TEST(ProjectionSearch, ExecutorsAgreeOnManyTargets) {
  SceneSize size;
  size.landmarks = 5000;
  size.targets = 60;
  size.clutter = 300;
  for (const bool fisheye : {false, true}) {
    const Scene scene = random_scene(77, fisheye, size);
    const auto reference = run(Executor::reference(), scene, rule(1));
    const auto cpu = run(Executor::cpu(), scene, rule(1));
    int matches = 0;
    for (std::size_t t = 0; t < reference.size(); ++t) {
      expect_equal(reference[t], cpu[t]);
      matches += reference[t].count;
    }
    EXPECT_GT(matches, 1000);
  }
}

TEST(ProjectionSearch, EmptyInputs) {
  SceneSize none;
  none.landmarks = 0;
  Scene scene = random_scene(1, false, none);
  for (const Executor executor : {Executor::reference(), Executor::cpu()}) {
    for (const auto& r : run(executor, scene, {})) EXPECT_EQ(r.count, 0);
    search_by_projection(executor, scene.rig, scene.scales, {}, scene.landmarks.view(), {}, {});
    Scene blind = random_scene(1, false, {});
    for (FeatureSet& f : blind.features) {
      f = FeatureSet();
      finish(f, blind.rig.left);
    }
    blind.blocked.assign(blind.features.size(), {});
    for (const auto& r : run(executor, blind, {})) {
      EXPECT_EQ(r.count, 0);
      EXPECT_EQ(r.keypoint.size(), blind.landmarks.p_world.size());
    }
  }
}

TEST(ProjectionSearch, RejectsUnequalExtents) {
  Scene scene = random_scene(1, false, {});
  const Executor executor = Executor::cpu();
  auto targets = scene.targets();
  std::vector<ProjectionMatches> results(targets.size());
  const auto call = [&](const std::vector<SearchTarget>& t, const LandmarkView& view) {
    search_by_projection(executor, scene.rig, scene.scales, t, view, {}, results);
  };
  EXPECT_NO_THROW(call(targets, scene.landmarks.view()));
  LandmarkView shorter = scene.landmarks.view();
  shorter.normal_world = shorter.normal_world.subspan(1);
  EXPECT_THROW(call(targets, shorter), InvalidArgument);
  shorter = scene.landmarks.view();
  shorter.descriptor = shorter.descriptor.subspan(1);
  EXPECT_THROW(call(targets, shorter), InvalidArgument);
  auto bad = targets;
  const std::vector<std::uint8_t> one(1);
  bad[0].landmark_skipped = one;
  EXPECT_THROW(call(bad, scene.landmarks.view()), InvalidArgument);
  bad = targets;
  bad[0].keypoint_blocked = one;
  EXPECT_THROW(call(bad, scene.landmarks.view()), InvalidArgument);
  bad = targets;
  bad[0].features = nullptr;
  EXPECT_THROW(call(bad, scene.landmarks.view()), InvalidArgument);
  results.resize(1);
  EXPECT_THROW(call(targets, scene.landmarks.view()), InvalidArgument);
}

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
