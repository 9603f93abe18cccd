#include "fastloop/matching/projection_search.hpp"

#include <gtest/gtest.h>

#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/expectations_for_tests.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::expect_equal;
using testing::finish;
using testing::random_scene;
using testing::rule;
using testing::run;
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

/// The matches of a result for each landmark, by keypoint.
std::vector<KeypointMatch> list_of(const ProjectionMatches& m) {
  std::vector<KeypointMatch> list;
  for (std::size_t i = 0; i < m.keypoint.size(); ++i)
    if (m.keypoint[i] != kNoMatch)
      list.push_back({static_cast<std::uint32_t>(i), static_cast<std::uint16_t>(m.keypoint[i]),
                      m.distance[i]});
  std::sort(list.begin(), list.end(),
            [](const auto& a, const auto& b) { return a.keypoint < b.keypoint; });
  return list;
}

TEST(ProjectionSearch, ListsOfSeveralJobsSayTheSame) {
  std::vector<Scene> scenes;
  for (unsigned seed = 0; seed < 5; ++seed) {
    SceneSize size;
    size.landmarks = seed == 3 ? 0 : 100 + 300 * static_cast<int>(seed);
    size.targets = seed == 2 ? 0 : 1 + static_cast<int>(seed);
    scenes.push_back(random_scene(seed, false, size));
  }
  std::vector<std::vector<SearchTarget>> targets;
  for (const Scene& s : scenes) targets.push_back(s.targets());
  std::vector<ProjectionJob> jobs;
  for (std::size_t s = 0; s < scenes.size(); ++s)
    jobs.push_back({scenes[s].landmarks.view(), targets[s]});
  for (const Executor& executor : {Executor::reference(), Executor::cpu()}) {
    const MatchLists lists =
        find_by_projection(executor, scenes[0].rig, scenes[0].scales, jobs, rule(1));
    std::size_t next = 0, matches = 0;
    for (const Scene& scene : scenes)
      for (const ProjectionMatches& expected : run(Executor::reference(), scene, rule(1))) {
        const auto found = lists[next++];
        EXPECT_EQ(std::vector<KeypointMatch>(found.begin(), found.end()), list_of(expected));
        matches += found.size();
      }
    EXPECT_EQ(lists.size(), next);
    EXPECT_GT(matches, 50u);
  }
}

TEST(ProjectionSearch, EmptyInputs) {
  SceneSize none;
  none.landmarks = 0;
  Scene scene = random_scene(1, false, none);
  for (const Executor& executor : {Executor::reference(), Executor::cpu()}) {
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

}  // namespace
}  // namespace fastloop::matching
