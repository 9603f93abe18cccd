#pragma once

#include <cmath>
#include <numbers>

#include "fastloop/map/essential_graph.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::map::testing {

/// A map of keyframes on a circle, looking ahead, one metre apart. Each brings `fresh` landmarks,
/// which the next `reach` keyframes see as well: keyframes d apart share fresh * (reach + 1 - d)
/// landmarks. Keypoints mean nothing; the map is for what works on its structure alone.
struct RingMapOptions {
  int keyframes = 100;
  int fresh = 50;
  int reach = 6;
  int unused_keypoints = 0;  ///< more keypoints without landmark, in every keyframe
  bool imu = true;           ///< measurements between all keyframes
  double yaw_drift = 0.002;  ///< radians a keyframe: what odometry thinks it turned too much
};

inline constexpr Nanoseconds kRingStepNs = 200'000'000;

inline std::shared_ptr<const FeatureSet> ring_features(int count) {
  std::mt19937 rng(7);
  std::uniform_real_distribution<double> u(0, 1);
  SyntheticView view;
  for (int i = 0; i < count; ++i)
    add_keypoint(view, {750 * u(rng), 478 * u(rng)}, NAN, 0, 0, random_descriptor(rng), -1);
  finish(view, pinhole_rig().left);
  return view.features;
}

/// True pose i of a ring of n keyframes, and the pose that odometry believes.
inline SE3 ring_truth(int i, int n) {
  const double angle = 2 * std::numbers::pi * i / n, radius = n / (2 * std::numbers::pi);
  return SE3(so3::exp({0, 0, angle + std::numbers::pi / 2}),
             Vector3d(radius * std::cos(angle), radius * std::sin(angle), 0));
}

inline Map ring_map(const RingMapOptions& options) {
  Map map(pinhole_rig(), PyramidScales{});
  const MapId id = map.start_map();
  const auto fresh = static_cast<std::uint32_t>(options.fresh);
  const auto features =
      ring_features(options.fresh * (options.reach + 1) + options.unused_keypoints);
  std::vector<std::vector<LandmarkId>> created;
  NavState state;
  for (int i = 0; i < options.keyframes; ++i) {
    const SE3 truth = ring_truth(i, options.keyframes);
    if (i == 0) {
      state.T_world_body = truth;
    } else {
      SE3 motion = ring_truth(i - 1, options.keyframes).inverse() * truth;
      motion.rotation = motion.rotation * so3::exp({0, 0, options.yaw_drift});
      state.T_world_body = state.T_world_body * motion;
    }
    state.v_world = state.T_world_body.rotation * Vector3d(1, 0, 0);
    auto data = std::make_shared<KeyframeData>();
    data->frame = FrameId(static_cast<std::uint32_t>(i));
    data->stamp_ns = kRingStepNs * i;
    data->features = features;
    std::shared_ptr<const PreintegratedImu> imu;
    if (options.imu && i > 0) {
      const Nanoseconds begin = kRingStepNs * (i - 1), end = kRingStepNs * i;
      imu = std::make_shared<const PreintegratedImu>(
          synthetic::regular_samples(begin, end, kRingStepNs / 4), begin, end, ImuBias{},
          ImuCalibration{});
    }
    const KeyframeId k = map.add_keyframe(id, data, state, imu);
    created.emplace_back();
    for (std::uint32_t j = 0; j < fresh; ++j)
      created.back().push_back(
          map.add_landmark(k, j, state.T_world_body * Vector3d(5 + 0.1 * j, 1, 1)));
    for (int d = 1; d <= std::min(i, options.reach); ++d)
      for (std::uint32_t j = 0; j < fresh; ++j)
        map.add_observation(created[static_cast<std::size_t>(i - d)][j], k,
                            static_cast<std::uint32_t>(d) * fresh + j);
    map.attach_to_spanning_tree(k);
  }
  return map;
}

/// The last keyframe has come back to the first: the loop as place recognition would hand it over.
inline ClosedLoop ring_loop(const Snapshot& map) {
  const auto slots = static_cast<std::uint32_t>(map.keyframe_slots());
  const int n = static_cast<int>(slots);
  ClosedLoop loop;
  loop.edge = {KeyframeId(0), KeyframeId(slots - 1),
               ring_truth(0, n).inverse() * ring_truth(n - 1, n)};
  loop.fixed = KeyframeId(0);
  const SE3 current = map.T_world_body(loop.edge.a) * loop.edge.T_a_b;
  const SE3 motion = current * map.T_world_body(loop.edge.b).inverse();
  for (std::uint32_t k = slots - std::min(10u, slots / 2); k < slots; ++k) {
    loop.corrected.push_back({KeyframeId(k), motion * map.T_world_body(KeyframeId(k))});
    for (std::uint32_t m = 0; m < 3; ++m)
      loop.connections.push_back({KeyframeId(k), KeyframeId(m), k + 5 > slots ? 120 : 60});
  }
  return loop;
}

}  // namespace fastloop::map::testing
