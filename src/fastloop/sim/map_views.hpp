#pragma once

#include <optional>
#include <span>
#include <utility>

#include "fastloop/sim/map_route.hpp"
#include "fastloop/sim/random.hpp"

/// The points of a simulated map's world and what a keyframe sees of them. Part of simulate_map.
namespace fastloop::sim {

struct WorldPoint {
  Vector3d p_world = Vector3d::Zero();
  double home = 0;               ///< position on its road
  float before = 0, behind = 0;  ///< seen from [home - before, home + behind]
  float farthest_m = 0;          ///< distance at which it falls out of the scale pyramid
  float angle_rad = 0;
  Descriptor descriptor;
};

struct PointSighting {
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();
  Vector3d p_left = Vector3d::Zero();
  int octave = 0;
};

/// The rig and everything that is drawn at random about views.
class ViewModel {
 public:
  ViewModel(const MapWorldOptions& options, const StereoRig& rig, double window);

  /// A point as it looks from the middle of a road.
  WorldPoint make_point(const SE3& T_world_body, double home, Random& random) const;
  std::optional<PointSighting> see(const WorldPoint& point, const SE3& T_left_world) const;
  /// Number of keyframes `step` apart on a straight road that see a point, on average.
  double mean_sightings(const SE3& T_carrier_body, double step) const;

  /// A point of the world in the way of a run.
  struct Appearance {
    double way;
    std::uint32_t point, slot;  ///< landmarks are one per slot
  };
  struct SlotKeypoint {
    std::uint32_t slot, keypoint;
  };
  /// Features of a keyframe: sightings of `near` and keypoints of nothing, mixed.
  std::pair<std::shared_ptr<FeatureSet>, std::vector<SlotKeypoint>> view(
      const RouteStop& stop, std::span<const Appearance> near, std::span<const WorldPoint> points,
      Random random) const;

 private:
  Descriptor word(Random& random) const;
  void add(FeatureSet& f, const PointSighting& s, float angle, const Descriptor& descriptor,
           Random& random) const;
  void add_right(FeatureSet& f, const PointSighting& s, double sigma, Random& random) const;
  void add_nothing(FeatureSet& f, Random& random) const;

  MapWorldOptions options_;
  StereoRig rig_;
  PyramidScales scales_;
  double window_;
  std::vector<std::uint32_t> leaves_;  ///< of the vocabulary
};

}  // namespace fastloop::sim
