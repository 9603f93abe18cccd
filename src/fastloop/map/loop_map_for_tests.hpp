#pragma once

#include "fastloop/map/synthetic_map_for_tests.hpp"

namespace fastloop::map::testing {

struct LoopMapOptions {
  int points = 150;
  int early = 3, late = 3;  ///< keyframes before and after the world was forgotten
  bool fisheye = false;
  bool two_maps = false;
  double landmark_share = 0.6;  ///< of the keypoints; the others are free
  int shared_looks = 0;         ///< so many appearances for every tenth point: ties
  bool crowded = false;         ///< most points within one cell of the grid
  double turned_share = 0;      ///< of the late keyframes that look the other way
  SE3 T_drift;                  ///< of the late keyframes: drift * truth
};

/// A room seen twice. What the late keyframes see is mapped a second time, at a drifted place: no
/// landmark is seen from both sides, and many show the same point.
struct LoopMap {
  SyntheticWorld world;
  SyntheticMap made;
  std::vector<KeyframeId> early, late;
  std::vector<int> point_of;  ///< [landmark slots]

  LoopMap(unsigned seed, const LoopMapOptions& o) : world(make_world(seed, o)), made(world) {
    std::mt19937 rng(seed + 1000);
    ViewOptions view;
    view.stereo_share = o.fisheye ? 0 : 0.7;
    view.clutter = 20;
    std::uniform_real_distribution<double> u(-1, 1);
    const auto add = [&](std::vector<KeyframeId>& to, bool turned) {
      const double x = 0.4 * u(rng), y = 0.4 * u(rng), z = 0.2 * u(rng);
      const double yaw = 0.15 * u(rng) + (turned ? M_PI : 0);
      to.push_back(made.add(pose_at({x, y, z}, yaw), view, rng, o.landmark_share));
    };
    for (int i = 0; i < o.early; ++i) add(early, false);
    made.landmark_of.assign(world.points.size(), LandmarkId{});
    if (o.two_maps) made.id = made.map.start_map();
    for (int i = 0; i < o.late; ++i) add(late, (u(rng) + 1) / 2 < o.turned_share);
    for (const KeyframeId id : late) {
      NavState state = made.map.keyframe(id).state;
      state.T_world_body = o.T_drift * state.T_world_body;
      made.map.set_state(id, state);
    }
    for (std::uint32_t l = 0; l < made.map.landmark_slots(); ++l) {
      const Observation& seen = made.map.landmark(LandmarkId(l)).observations.front();
      point_of.push_back(made.views[seen.keyframe.value()].point[seen.keypoint]);
    }
  }
  LoopMap(const LoopMap&) = delete;

  const Map& map() const { return made.map; }
  /// Where a late keyframe's camera truly is.
  SE3 true_camera(KeyframeId id) const {
    return (made.truth[id.value()] * world.rig.T_body_left).inverse();
  }

 private:
  static SyntheticWorld make_world(unsigned seed, const LoopMapOptions& o) {
    SyntheticWorld world(o.points, Vector3d(6, 4, 3), seed);
    if (o.fisheye) {
      const SE3 T_body_left = world.rig.T_body_left;
      world.rig = matching::testing::fisheye_rig();
      world.rig.T_body_left = T_body_left;
    }
    std::mt19937 rng(seed + 2000);
    std::vector<Descriptor> looks;
    for (int i = 0; i < o.shared_looks; ++i) looks.push_back(random_descriptor(rng));
    for (std::size_t i = 0; i < world.points.size(); ++i) {
      if (!looks.empty() && i % 10 == 0) world.descriptors[i] = looks[rng() % looks.size()];
      // Within a cell of 10 pixels when looked at from the origin.
      if (o.crowded && i % 8 != 0)
        world.points[i] = Vector3d(6, 0.5, 0.3) + normal_vector(rng, 0.01);
    }
    return world;
  }
};

/// One of many kinds of such maps, chosen by the seed; the smallest have no landmark, or one.
inline LoopMapOptions loop_map_options(unsigned seed) {
  std::mt19937 rng(seed + 3000);
  std::uniform_real_distribution<double> u(-1, 1);
  LoopMapOptions o;
  static constexpr int kPoints[] = {0, 1, 2, 30, 80, 150, 250};
  o.points = kPoints[rng() % 7];
  o.early = 1 + static_cast<int>(rng() % 5);
  o.late = 1 + static_cast<int>(rng() % 5);
  o.fisheye = seed % 2;
  o.two_maps = seed % 6 == 0;
  o.landmark_share = seed % 9 == 0 ? 1 : 0.6;
  o.shared_looks = seed % 3 == 0 ? 3 : 0;
  o.crowded = seed % 7 == 0;
  o.turned_share = seed % 5 == 0 ? 0.4 : 0;
  Vector3d turn, shift;
  for (int k = 0; k < 3; ++k) turn[k] = 0.05 * u(rng), shift[k] = 2 * u(rng);
  o.T_drift = SE3(so3::exp(turn), shift);
  return o;
}

}  // namespace fastloop::map::testing
