#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <random>
#include <vector>

#include "fastloop/map/map.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

/// A world of points with descriptors and the features a stereo rig sees of it: known truth for the
/// tests of map, mapping and tracking. Only tests include it.
namespace fastloop::map::testing {

inline Vector3d normal_vector(std::mt19937& rng, double sigma) {
  std::normal_distribution<double> n(0, sigma);
  const double x = n(rng), y = n(rng), z = n(rng);
  return {x, y, z};
}

using matching::testing::random_descriptor;
using matching::testing::with_flipped_bits;

/// Rectified stereo; the body's axes are x forward, y left, z up.
inline StereoRig pinhole_rig() {
  StereoRig rig = matching::testing::pinhole_rig();
  Matrix3d R_body_left;
  R_body_left << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  rig.T_body_left = SE3(R_body_left, Vector3d(0.05, 0.02, -0.03));
  return rig;
}

struct SyntheticWorld {
  StereoRig rig = pinhole_rig();
  PyramidScales scales;
  std::vector<Vector3d> points;
  std::vector<Descriptor> descriptors;  ///< [points]

  /// Points on the surface of a room about the origin with half edges `half`, metres.
  SyntheticWorld(int count, const Vector3d& half, unsigned seed) {
    std::mt19937 rng(seed);
    std::uniform_real_distribution<double> u(-1, 1);
    for (int i = 0; i < count; ++i) {
      Vector3d p(u(rng), u(rng), u(rng));
      const auto axis = static_cast<Eigen::Index>(rng() % 3);
      p[axis] = (rng() % 2 ? 1.0 : -1.0) * (0.9 + 0.1 * p[axis]);
      points.push_back(p.cwiseProduct(half));
      descriptors.push_back(random_descriptor(rng));
    }
  }
};

/// Features of one view, and which point each of them shows.
struct SyntheticView {
  std::shared_ptr<FeatureSet> features = std::make_shared<FeatureSet>();
  std::vector<int> point;  ///< [num_keypoints] -1: clutter
};

struct ViewOptions {
  double noise_px = 0.3;     ///< of the left and the right pixel, octave 0
  int flipped_bits = 10;     ///< of each descriptor, per view
  double stereo_share = 1;   ///< of the keypoints
  double max_stereo_m = 40;  ///< farther points get no right coordinate
  int clutter = 0;           ///< keypoints of nothing
};

inline void add_keypoint(SyntheticView& view, const Eigen::Vector2d& pixel, double right_x,
                         double depth, int octave, const Descriptor& descriptor, int point) {
  FeatureSet& f = *view.features;
  f.x.push_back(static_cast<float>(pixel.x()));
  f.y.push_back(static_cast<float>(pixel.y()));
  f.angle_rad.push_back(0.5f);
  f.octave.push_back(static_cast<std::uint8_t>(octave));
  f.descriptors.push_back(descriptor);
  f.right_x.push_back(static_cast<float>(right_x));
  f.right_y.push_back(static_cast<float>(std::isnan(right_x) ? NAN : pixel.y()));
  f.depth_m.push_back(std::isnan(right_x) ? 0.f : static_cast<float>(depth));
  view.point.push_back(point);
}

inline void finish(SyntheticView& view, const Camera& camera) {
  FeatureSet& f = *view.features;
  f.image_width = camera.width;
  f.image_height = camera.height;
  f.grid.build(f.x, f.y, camera.width, camera.height);
}

inline SyntheticView observe(const SyntheticWorld& world, const SE3& T_world_body,
                             const ViewOptions& options, std::mt19937& rng) {
  const Camera& camera = world.rig.left;
  const double fb = camera.fx * world.rig.baseline_m;
  const SE3 T_left_world = (T_world_body * world.rig.T_body_left).inverse();
  std::uniform_real_distribution<double> u(0, 1);
  SyntheticView view;
  for (std::size_t i = 0; i < world.points.size(); ++i) {
    const Vector3d p = T_left_world * world.points[i];
    if (!(p.z() > 0.3) || !camera.contains(camera.project(p))) continue;
    // A point is found at the octave that shows a patch of fixed size in metres.
    const int octave =
        std::clamp(static_cast<int>(std::lround(std::log(8.0 / p.norm()) / std::log(1.2))), 0, 7);
    const double sigma = options.noise_px * world.scales.scale[static_cast<std::size_t>(octave)];
    const Vector3d noise = normal_vector(rng, sigma);
    const Eigen::Vector2d pixel = camera.project(p) + noise.head<2>();
    double disparity = fb / p.z() + noise.z() - noise.x();
    const bool stereo =
        u(rng) < options.stereo_share && p.z() < options.max_stereo_m && disparity > 0.1;
    const Descriptor d = with_flipped_bits(world.descriptors[i], options.flipped_bits, rng);
    if (!camera.contains(pixel)) continue;
    add_keypoint(view, pixel, stereo ? pixel.x() - disparity : NAN, fb / disparity, octave, d,
                 static_cast<int>(i));
  }
  for (int i = 0; i < options.clutter; ++i) {
    const Eigen::Vector2d pixel(u(rng) * (camera.width - 1), u(rng) * (camera.height - 1));
    const double disparity = 2 + 30 * u(rng);
    add_keypoint(view, pixel, pixel.x() - disparity, fb / disparity, static_cast<int>(rng() % 4),
                 random_descriptor(rng), -1);
  }
  finish(view, camera);
  return view;
}

inline std::shared_ptr<const KeyframeData> keyframe_data(const SyntheticView& view, FrameId frame,
                                                         Nanoseconds stamp_ns) {
  auto data = std::make_shared<KeyframeData>();
  data->frame = frame;
  data->stamp_ns = stamp_ns;
  data->features = view.features;
  return data;
}

/// A map of one world, built keyframe by keyframe; remembers which landmark shows which point.
struct SyntheticMap {
  const SyntheticWorld& world;
  Map map;
  MapId id;
  std::vector<LandmarkId> landmark_of;  ///< [points] invalid: not in the map yet
  std::vector<SyntheticView> views;     ///< [keyframes]
  std::vector<SE3> truth;               ///< [keyframes] T_world_body
  Nanoseconds interval_ns = 200'000'000;

  explicit SyntheticMap(const SyntheticWorld& w)
      : world(w), map(w.rig, w.scales), id(map.start_map()), landmark_of(w.points.size()) {}

  /// Keyframe at its true pose; points it sees are added as landmarks (at their true place) or
  /// observed.
  KeyframeId add(const SE3& T_world_body, const ViewOptions& options, std::mt19937& rng,
                 double landmark_share = 1) {
    std::uniform_real_distribution<double> u(0, 1);
    NavState state;
    state.T_world_body = T_world_body;
    views.push_back(observe(world, T_world_body, options, rng));
    truth.push_back(T_world_body);
    const auto n = static_cast<std::uint32_t>(map.keyframe_slots());
    const KeyframeId k = map.add_keyframe(
        id, keyframe_data(views.back(), FrameId(n), n * interval_ns), state, nullptr);
    for (std::uint32_t i = 0; i < views.back().point.size(); ++i) {
      const int p = views.back().point[i];
      if (p < 0 || u(rng) >= landmark_share) continue;
      LandmarkId& l = landmark_of[static_cast<std::size_t>(p)];
      if (!l.valid())
        l = map.add_landmark(k, i, world.points[static_cast<std::size_t>(p)]);
      else if (map.add_observation(l, k, i))
        map.refresh_landmark(l);
    }
    map.attach_to_spanning_tree(k);
    return k;
  }
};

/// Pose looking along the x axis turned by `yaw` about z.
inline SE3 pose_at(const Vector3d& position, double yaw) {
  return SE3(so3::exp({0, 0, yaw}), position);
}

}  // namespace fastloop::map::testing
