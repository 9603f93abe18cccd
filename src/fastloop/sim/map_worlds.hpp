#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/map/map.hpp"

namespace fastloop::sim {

struct MapWorldOptions {
  int keyframes = 1000;  ///< in total, 60 .. 1,000,000
  int covisible = 20;    ///< keyframes that share landmarks with one, 8 .. 400
  int loops = 0;         ///< loops closed earlier; one more is pending
  std::uint64_t seed = 1;
  int features = 1000;          ///< keypoints of a keyframe, 50 .. 20,000
  double landmark_share = 0.5;  ///< of the keypoints, about; the rest shows nothing that is mapped
  double noise_px = 0.5;        ///< of a keypoint's coordinates, at octave 0
  int flipped_bits = 10;        ///< of a descriptor from view to view, on average
  /// Drift when the loop is reached: 1 = a position error of 0.3 % of the way since then; 0 = none.
  double drift_scale = 1;
  bool fisheye = false;   ///< two Kannala-Brandt cameras instead of a rectified pair
  bool inertial = false;  ///< the map says that gravity, scale and biases are known
  /// Tracking was lost half way: what came after is a second map with a world frame of its own.
  bool two_maps = false;

  void validate() const;  ///< @throws InvalidArgument
};

/// A map as SLAM leaves it behind, made without images, at the moment in which the last keyframe
/// has come back to where the run began and nobody has noticed yet.
///
/// The way is one big circuit with small detours that begin and end on it; a detour's return is a
/// loop that was closed (shared landmarks, a loop edge). Poses drift in yaw and position, slowly
/// enough that neighbours agree with their landmarks. What is seen again at the end of the circuit
/// is mapped a second time, at the drifted place: no landmark is seen from both sides of the
/// pending loop.
struct SimulatedMap {
  map::Map map;
  KeyframeId current;                        ///< the last keyframe
  std::vector<KeyframeId> expected_matches;  ///< that saw the same place, the nearest first
  SE3 T_matched_current;                ///< truth, body frames; matched = expected_matches.front()
  std::vector<SE3> truth;               ///< [keyframe slots] true T_world_body
  std::vector<std::uint32_t> point_of;  ///< [landmark slots] the world point a landmark shows
};

/// Depends on the options alone. @throws InvalidArgument also when the keyframes are too few for
/// so many loops
SimulatedMap simulate_map(const MapWorldOptions& options);

}  // namespace fastloop::sim
