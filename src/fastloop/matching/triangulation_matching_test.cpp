#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::add_keypoint;
using testing::finish;

constexpr bool kFisheye = true;

/// Distance in pixels of a keypoint from the epipolar curve, by brute force: the nearest image of
/// the points on the first ray (both ways along it, for an epipolar plane has two sides).
double epipolar_distance_px(const Camera& camera, const SE3& T_second_first, const Vector3d& ray,
                            const Eigen::Vector2d& pixel) {
  double best = 1e9, best_angle = 0;
  const Vector3d a = T_second_first.rotation * ray, b = T_second_first.translation.normalized();
  const auto scan = [&](double from, double to, double step) {
    for (double angle = from; angle < to; angle += step) {
      const Vector3d p = std::cos(angle) * a + std::sin(angle) * b;
      if (!camera.is_projectable(p)) continue;
      const double d = (camera.project(p) - pixel).norm();
      if (d < best) best = d, best_angle = angle;
    }
  };
  scan(0, 2 * M_PI, 1e-3);
  scan(best_angle - 2e-3, best_angle + 2e-3, 1e-5);
  return best;
}

class TriangulationMatching : public ::testing::TestWithParam<bool> {
 protected:
  TriangulationMatching() {
    rig_ = GetParam() == kFisheye ? testing::fisheye_rig() : testing::pinhole_rig();
    first_pose_ = SE3(so3::exp({0.1, -0.2, 0.05}), Vector3d(0.3, 0.1, -0.2));
    second_pose_ = SE3(so3::exp({0.02, 0.1, -0.03}), Vector3d(-0.4, 0.15, 0.1)) * first_pose_;
  }

  /// The same point in both images; the second pixel is moved by `offset`.
  bool add_point(const Vector3d& p_world, std::mt19937& rng, const Eigen::Vector2d& offset = {0, 0},
                 bool depth = false) {
    const Vector3d a = first_pose_ * p_world, b = second_pose_ * p_world;
    if (!rig_.left.is_projectable(a) || !rig_.left.is_projectable(b)) return false;
    const Eigen::Vector2d u = rig_.left.project(a), v = rig_.left.project(b) + offset;
    if (!rig_.left.contains(u, 5) || !rig_.left.contains(v, 5)) return false;
    const Descriptor d = testing::random_descriptor(rng);
    add_keypoint(first_, u.x(), u.y(), 0, d, 0, depth ? 1 : NAN, depth ? 1 : NAN);
    add_keypoint(second_, v.x(), v.y(), 0, testing::with_flipped_bits(d, 10, rng));
    return true;
  }

  std::vector<IndexPair> match(const TriangulationMatchOptions& options = {}) {
    finish(first_, rig_.left);
    finish(second_, rig_.left);
    const TriangulationSide a{{&first_, nullptr, first_blocked_}, first_pose_, nullptr};
    const TriangulationSide b{{&second_, nullptr, second_blocked_}, second_pose_, nullptr};
    const auto reference =
        search_for_triangulation(Executor::reference(), rig_, scales_, a, b, options);
    EXPECT_EQ(search_for_triangulation(Executor::cpu(), rig_, scales_, a, b, options), reference);
    return reference;
  }

  StereoRig rig_;
  PyramidScales scales_;
  SE3 first_pose_, second_pose_;
  FeatureSet first_, second_;
  std::vector<std::uint8_t> first_blocked_, second_blocked_;
};
INSTANTIATE_TEST_SUITE_P(BothCameras, TriangulationMatching, ::testing::Bool());

TEST_P(TriangulationMatching, FindsTruePointsAndOnlyThoseOnTheEpipolarCurve) {
  std::mt19937 rng(21);
  std::uniform_real_distribution<double> u(-1, 1);
  TriangulationMatchOptions options;
  options.min_epipole_px = 0;
  while (first_.size() < 150)
    add_point({3 * u(rng), 2 * u(rng), 4 + 2 * u(rng)}, rng, 3.5 * Eigen::Vector2d(u(rng), u(rng)));
  const auto pairs = match(options);
  std::vector<bool> matched(first_.size(), false);
  for (const IndexPair& p : pairs) {
    EXPECT_EQ(p.first, p.second);
    matched[p.first] = true;
  }
  const SE3 T_second_first = second_pose_ * first_pose_.inverse();
  int on = 0, off = 0;
  for (std::size_t i = 0; i < first_.size(); ++i) {
    const Vector3d ray = rig_.left.unproject({first_.x[i], first_.y[i]});
    const double d =
        epipolar_distance_px(rig_.left, T_second_first, ray, {second_.x[i], second_.y[i]});
    const double threshold = std::sqrt(3.84);      // at octave 0
    if (std::abs(d - threshold) < 0.03) continue;  // first-order distance
    EXPECT_EQ(matched[i], d < threshold) << d;
    ++(d < threshold ? on : off);
  }
  EXPECT_GT(on, 30);
  EXPECT_GT(off, 20);
}

TEST_P(TriangulationMatching, ExecutorsAgreeOnRandomScenes) {
  int situations = 0, found = 0;
  for (unsigned seed = 0; seed < 100; ++seed) {
    std::mt19937 rng(seed);
    std::uniform_real_distribution<double> u(-1, 1);
    first_ = second_ = FeatureSet();
    first_blocked_ = second_blocked_ = {};
    std::vector<Descriptor> looks;  // a few that many points share: ties
    for (int i = 0; i < 3; ++i) looks.push_back(testing::random_descriptor(rng));
    // Nothing, one point, many in front and behind, and all within a cell of the grid.
    static constexpr int kSizes[] = {0, 1, 40, 150};
    const int count = kSizes[seed % 4];
    const double spread = seed % 8 == 7 ? 0.01 : 2.5;
    for (int i = 0; i < count; ++i) {
      const double depth = seed % 3 == 0 && i % 4 == 0 ? -4 : 4;
      add_point({spread * u(rng), spread * u(rng), depth + u(rng)}, rng,
                3 * Eigen::Vector2d(u(rng), u(rng)), i % 3 == 0);
    }
    for (FeatureSet* f : {&first_, &second_})
      for (std::size_t i = 0; i < f->size(); ++i) {
        f->octave[i] = static_cast<std::uint8_t>(rng() % 4);
        if (seed % 5 == 0 && i % 2 == 0) f->descriptors[i] = looks[i / 2 % 3];
      }
    if (seed % 4 == 3)
      for (std::size_t i = 0; i < first_.size(); ++i) {
        first_blocked_.push_back(rng() % 4 == 0);
        second_blocked_.push_back(rng() % 4 == 0);
      }
    TriangulationMatchOptions options;
    options.check_rotation = seed % 2;
    options.min_epipole_px = seed % 6 == 0 ? 0 : 10;
    SCOPED_TRACE(seed);
    const auto pairs = match(options);  // compares the executors
    std::vector<std::uint8_t> taken(second_.size(), 0);
    for (const IndexPair& p : pairs) {
      EXPECT_FALSE(taken[p.second]++);
      if (!first_blocked_.empty()) {
        EXPECT_FALSE(first_blocked_[p.first] || second_blocked_[p.second]);
      }
    }
    ++situations;
    found += static_cast<int>(pairs.size());
  }
  EXPECT_GE(situations, 100);  // and as many with the other camera
  EXPECT_GT(found, 500);
}

TEST_P(TriangulationMatching, HigherOctavesAreLessPrecise) {
  std::mt19937 rng(22);
  const SE3 T_second_first = second_pose_ * first_pose_.inverse();
  const Vector3d p(0.4, 0.2, 4);
  const Vector3d ray = (first_pose_ * p).normalized();
  const Eigen::Vector2d v = rig_.left.project(second_pose_ * p);
  // Move across the epipolar curve until 3 pixels away from it.
  Eigen::Vector2d offset(0, 3);
  offset *= 3 / epipolar_distance_px(rig_.left, T_second_first, ray, v + offset);
  ASSERT_TRUE(add_point(p, rng, offset));
  for (int octave = 0; octave < 8; ++octave) {
    second_.octave[0] = static_cast<std::uint8_t>(octave);
    EXPECT_EQ(match().size(), 9 <= 3.84 * scales_.sigma2[octave] ? 1u : 0u) << octave;
  }
}

TEST_P(TriangulationMatching, NearTheEpipoleOnlyKeypointsWithDepth) {
  second_pose_ = SE3(so3::exp({0.01, 0, 0}), Vector3d(0.02, 0.01, 0.5)) * first_pose_;
  const Vector3d epipole = (second_pose_ * first_pose_.inverse()).translation.normalized();
  const Vector3d side = epipole.unitOrthogonal();
  for (const double px : {9.0, 11.0})
    for (const bool depth : {false, true}) {
      std::mt19937 rng(23);
      first_ = second_ = FeatureSet();
      const Vector3d ray = so3::exp(std::asin(px / rig_.left.fx) * side.cross(epipole)) * epipole;
      ASSERT_TRUE(add_point(second_pose_.inverse() * Vector3d(5 * ray), rng, {0, 0}, depth));
      EXPECT_EQ(match().size(), px > 10 || depth ? 1u : 0u);
    }
}

TEST_P(TriangulationMatching, BlockedDistanceAndGroups) {
  std::mt19937 rng(24);
  ASSERT_TRUE(add_point({0.3, 0.2, 4}, rng));
  ASSERT_TRUE(add_point({-0.5, 0.4, 3}, rng));
  EXPECT_EQ(match(), (std::vector<IndexPair>{{0, 0}, {1, 1}}));
  first_blocked_ = {1, 0};
  EXPECT_EQ(match(), (std::vector<IndexPair>{{1, 1}}));
  second_blocked_ = {0, 1};
  EXPECT_TRUE(match().empty());
  first_blocked_ = second_blocked_ = {};

  const int distance = hamming_distance(first_.descriptors[0], second_.descriptors[0]);
  TriangulationMatchOptions options;
  options.max_distance = distance;
  EXPECT_EQ(match(options)[0], (IndexPair{0, 0}));
  options.max_distance = distance - 1;
  for (const IndexPair& p : match(options)) EXPECT_NE(p.first, 0);

  const FeatureGroups a{{3, 7}, {0, 1, 2}, {0, 1}}, b{{3, 8}, {0, 1, 2}, {0, 1}};
  const TriangulationSide first{{&first_, &a, {}}, first_pose_, nullptr};
  const TriangulationSide second{{&second_, &b, {}}, second_pose_, nullptr};
  EXPECT_EQ(search_for_triangulation(Executor::cpu(), rig_, scales_, first, second),
            (std::vector<IndexPair>{{0, 0}}));
}

TEST_P(TriangulationMatching, OneCentreGivesNothingAndBrokenInputThrows) {
  std::mt19937 rng(25);
  ASSERT_TRUE(add_point({0.3, 0.2, 4}, rng));
  const SE3 pose = second_pose_;
  second_pose_ = first_pose_;
  EXPECT_TRUE(match().empty());
  second_pose_ = pose;
  const Bearings none;
  const TriangulationSide a{{&first_, nullptr, {}}, first_pose_, &none};
  const TriangulationSide b{{&second_, nullptr, {}}, second_pose_, nullptr};
  EXPECT_THROW(search_for_triangulation(Executor::cpu(), rig_, scales_, a, b), InvalidArgument);
  second_.octave[0] = 8;
  const TriangulationSide c{{&first_, nullptr, {}}, first_pose_, nullptr};
  EXPECT_THROW(search_for_triangulation(Executor::cpu(), rig_, scales_, c, b), InvalidArgument);
}

TEST_P(TriangulationMatching, BearingsTurnAsTheCameraSays) {
  std::mt19937 rng(26);
  FeatureSet f;
  for (int i = 0; i < 50; ++i) add_keypoint(f, 30 + rng() % 440, 30 + rng() % 400, 0, {});
  const Bearings b = compute_bearings(rig_.left, f);
  for (std::size_t i = 0; i < f.size(); ++i)
    for (int axis = 0; axis < 2; ++axis) {
      const Eigen::Vector2d h = 1e-3 * Eigen::Vector2d::Unit(axis), u(f.x[i], f.y[i]);
      const Vector3d slope = (rig_.left.unproject(u + h) - rig_.left.unproject(u - h)) / 2e-3;
      EXPECT_LT((slope - b.d_ray_d_pixel[i].col(axis).cast<double>()).norm(), 1e-6);
    }
}

}  // namespace
}  // namespace fastloop::matching
