#pragma once

#include <string>
#include <vector>

#include "fastloop/map/map.hpp"
#include "fastloop/mapping/options.hpp"
#include "fastloop/optimization/bundle_adjustment.hpp"

namespace fastloop::mapping {

/// A bundle adjustment problem cut out of the map, and the way back.
class MapAdjustment {
 public:
  /// Keyframes `free` are optimised, `fixed` are held; landmarks seen by a free keyframe take part
  /// (at most max_points of them, those with most observations).
  /// With `inertial`, consecutive free keyframes (and a fixed one before them) are joined by their
  /// IMU measurements.
  MapAdjustment(const map::Map& map, const std::vector<KeyframeId>& free,
                const std::vector<KeyframeId>& fixed, bool inertial, std::size_t max_points);

  optimization::BundleProblem& problem() { return problem_; }
  /// Writes poses, motions and points back and removes the outlier observations.
  /// Does nothing but report when the result is not usable.
  void apply(map::Map& map, const optimization::BundleResult& result) const;

 private:
  void add_poses(const map::Map&, const std::vector<KeyframeId>& free,
                 const std::vector<KeyframeId>& fixed);
  void add_points(const map::Map&, std::size_t num_free, std::size_t max_points);
  void add_imu_edges(const map::Map&);

  optimization::BundleProblem problem_;
  std::vector<KeyframeId> keyframes_;   ///< [poses]
  std::vector<LandmarkId> landmarks_;   ///< [points]
  std::vector<map::Observation> seen_;  ///< [observations] keyframe and keypoint
};

/// Adjusts the surroundings of the newest keyframe: covisible keyframes, or with an initialised IMU
/// the last keyframes in time. Returns what the optimiser reported.
optimization::BundleResult adjust_locally(map::Map& map, KeyframeId keyframe, bool inertial,
                                          const MappingOptions& options,
                                          const std::atomic<bool>* cancel);

/// Adjusts a whole map, visual-inertially. The first keyframe holds the gauge.
optimization::BundleResult adjust_whole_map(map::Map& map, MapId id, bool inertial, int iterations,
                                            const MappingOptions& options,
                                            const std::atomic<bool>* cancel);

}  // namespace fastloop::mapping
