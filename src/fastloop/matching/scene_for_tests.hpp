#pragma once

#include <random>

#include "fastloop/matching/projection_search.hpp"

namespace fastloop::matching::testing {

inline StereoRig pinhole_rig() {
  StereoRig rig;
  rig.left = {CameraModel::kPinhole, 752, 480, 435.0, 436.0, 370.0, 240.0, {}};
  rig.right = rig.left;
  rig.baseline_m = 0.11;
  rig.T_right_left.translation = {-0.11, 0, 0};
  return rig;
}

inline StereoRig fisheye_rig() {
  StereoRig rig;
  rig.kind = StereoRig::Kind::kGeneral;
  rig.left = {CameraModel::kKannalaBrandt,        512, 512, 191.0, 191.0, 255.0, 257.0,
              {0.0035, 0.0007, -0.002, 0.0002, 0}};
  rig.right = rig.left;
  rig.right.cx = 252.6;
  rig.baseline_m = 0.1;
  rig.T_right_left = SE3(so3::exp({0.001, 0.01, 0.002}), Vector3d(-0.1, 0.001, 0.002));
  return rig;
}

inline Descriptor random_descriptor(std::mt19937& rng) {
  Descriptor d;
  for (auto& word : d.words) word = (static_cast<std::uint64_t>(rng()) << 32) | rng();
  return d;
}

inline Descriptor with_flipped_bits(Descriptor d, int flips, std::mt19937& rng) {
  for (int i = 0; i < flips; ++i) {
    const unsigned bit = rng() % 256;
    d.words[bit / 64] ^= std::uint64_t{1} << (bit % 64);
  }
  return d;
}

/// Appends a keypoint; NaN right coordinates mean no stereo match.
inline void add_keypoint(FeatureSet& f, double x, double y, int octave, const Descriptor& d,
                         float angle_rad = 0, double right_x = NAN, double right_y = NAN) {
  f.x.push_back(static_cast<float>(x));
  f.y.push_back(static_cast<float>(y));
  f.octave.push_back(static_cast<std::uint8_t>(octave));
  f.descriptors.push_back(d);
  f.angle_rad.push_back(angle_rad);
  f.right_x.push_back(static_cast<float>(right_x));
  f.right_y.push_back(static_cast<float>(right_y));
  f.depth_m.push_back(std::isnan(right_x) ? 0.0f : 1.0f);
}

inline void finish(FeatureSet& f, const Camera& camera) {
  f.image_width = camera.width;
  f.image_height = camera.height;
  f.grid.build(f.x, f.y, f.image_width, f.image_height);
}

/// Landmarks with storage.
struct Landmarks {
  std::vector<Eigen::Vector3f> p_world, normal_world;
  std::vector<float> min_distance_m, max_distance_m;
  std::vector<Descriptor> descriptor;

  void add(const Vector3d& p, const Vector3d& normal, double min_m, double max_m,
           const Descriptor& d) {
    p_world.push_back(p.cast<float>());
    normal_world.push_back(normal.cast<float>());
    min_distance_m.push_back(static_cast<float>(min_m));
    max_distance_m.push_back(static_cast<float>(max_m));
    descriptor.push_back(d);
  }
  LandmarkView view() const {
    return {p_world, normal_world, min_distance_m, max_distance_m, descriptor};
  }
};

/// Landmarks around several cameras that each see some of them, with noise, clutter and mistaken
/// poses.
struct Scene {
  StereoRig rig;
  PyramidScales scales;
  Landmarks landmarks;
  std::vector<FeatureSet> features;
  std::vector<SE3> T_camera_world;
  std::vector<double> scale;
  std::vector<std::vector<std::uint8_t>> blocked, skipped;

  std::vector<SearchTarget> targets() const {
    std::vector<SearchTarget> t(features.size());
    for (std::size_t i = 0; i < t.size(); ++i)
      t[i] = {&features[i], T_camera_world[i], scale[i], blocked[i], skipped[i]};
    return t;
  }
};

struct SceneSize {
  int landmarks = 300, targets = 2, clutter = 200;
  double crowding = 0;  ///< share of the keypoints moved into a few cells
};

inline void add_random_landmarks(Scene& scene, const SceneSize& size, std::mt19937& rng) {
  std::uniform_real_distribution<double> u(-1, 1);
  std::vector<Descriptor> shared;  // a few appearances many landmarks share: ties
  for (int i = 0; i < 4; ++i) shared.push_back(random_descriptor(rng));
  for (int i = 0; i < size.landmarks; ++i) {
    const Vector3d p(6 * u(rng), 6 * u(rng), 6 * u(rng));
    const Vector3d normal = (p / 6 + 0.4 * Vector3d(u(rng), u(rng), u(rng))).normalized();
    const double seen_from = p.norm() * (1 + 0.3 * u(rng)) + 0.1;
    const int octave = static_cast<int>(rng() % scene.scales.levels);
    const double farthest = seen_from * scene.scales.scale[octave];
    scene.landmarks.add(p, normal, farthest / scene.scales.scale.back(), farthest,
                        rng() % 10 == 0 ? shared[rng() % 4] : random_descriptor(rng));
  }
}

inline FeatureSet observe(const Scene& scene, const SE3& T_camera_world, const SceneSize& size,
                          std::mt19937& rng) {
  std::uniform_real_distribution<double> u(-1, 1);
  const Camera& camera = scene.rig.left;
  FeatureSet f;
  for (std::size_t i = 0; i < scene.landmarks.p_world.size() && f.size() < 1500; ++i) {
    const Vector3d p = T_camera_world * scene.landmarks.p_world[i].cast<double>();
    if (rng() % 4 == 0 || !camera.is_projectable(p)) continue;
    Eigen::Vector2d pixel = camera.project(p);
    if (!camera.contains(pixel)) continue;
    const double ratio = scene.landmarks.max_distance_m[i] / p.norm();
    const int level = static_cast<int>(std::ceil(std::log(ratio) / std::log(1.2)));
    const int octave = std::clamp(level - static_cast<int>(rng() % 3), 0, 7);
    pixel += 4 * Eigen::Vector2d(u(rng), u(rng));
    if (!camera.contains(pixel)) continue;
    const bool stereo = rng() % 2 == 0;
    const double right_x = pixel.x() - camera.fx * scene.rig.baseline_m / p.norm() + 2 * u(rng);
    add_keypoint(
        f, pixel.x(), pixel.y(), octave,
        with_flipped_bits(scene.landmarks.descriptor[i], static_cast<int>(rng() % 60), rng),
        static_cast<float>(M_PI * (1 + u(rng))), stereo ? right_x : NAN,
        stereo ? pixel.y() + 2 * u(rng) : NAN);
  }
  for (int i = 0; i < size.clutter; ++i)
    add_keypoint(f, (1 + u(rng)) * 0.499 * camera.width, (1 + u(rng)) * 0.499 * camera.height,
                 static_cast<int>(rng() % 8),
                 with_flipped_bits(
                     scene.landmarks.descriptor.empty()
                         ? random_descriptor(rng)
                         : scene.landmarks.descriptor[rng() % scene.landmarks.descriptor.size()],
                     40, rng));
  for (std::size_t k = 0; k < f.size(); ++k)
    if (u(rng) < 2 * size.crowding - 1) {
      f.x[k] = static_cast<float>(200.3 + 3 * u(rng));
      f.y[k] = static_cast<float>(200.3 + 3 * u(rng));
    }
  finish(f, camera);
  return f;
}

inline Scene random_scene(unsigned seed, bool fisheye, const SceneSize& size) {
  std::mt19937 rng(seed);
  std::uniform_real_distribution<double> u(-1, 1);
  Scene scene;
  scene.rig = fisheye ? fisheye_rig() : pinhole_rig();
  add_random_landmarks(scene, size, rng);
  for (int t = 0; t < size.targets; ++t) {
    const SE3 pose(so3::exp(3 * Vector3d(u(rng), u(rng), u(rng))),
                   Vector3d(u(rng), u(rng), u(rng)));
    scene.features.push_back(observe(scene, pose, size, rng));
    Vector6d error;
    for (int k = 0; k < 6; ++k) error[k] = 0.003 * u(rng);
    scene.T_camera_world.push_back(pose.retract(error));
    scene.scale.push_back(t % 2 ? 1 + 0.2 * u(rng) : 1);
    std::vector<std::uint8_t> blocked, skipped;
    if (t % 3 != 0)
      for (std::size_t k = 0; k < scene.features.back().size(); ++k)
        blocked.push_back(rng() % 5 == 0);
    if (t % 2 != 0)
      for (int i = 0; i < size.landmarks; ++i) skipped.push_back(rng() % 5 == 0);
    scene.blocked.push_back(blocked);
    scene.skipped.push_back(skipped);
  }
  return scene;
}

/// The rules in use: loop detection, fusion, tracking of the local map, duplicates among
/// neighbours.
inline ProjectionSearchOptions rule(int which) {
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

inline std::vector<ProjectionMatches> run(const Executor& executor, const Scene& scene,
                                          const ProjectionSearchOptions& options) {
  const auto targets = scene.targets();
  std::vector<ProjectionMatches> results(targets.size());
  search_by_projection(executor, scene.rig, scene.scales, targets, scene.landmarks.view(), options,
                       results);
  return results;
}

}  // namespace fastloop::matching::testing
