#pragma once

#include <memory>
#include <vector>

#include "fastloop/core/ids.hpp"
#include "fastloop/geometry/se3.hpp"
#include "fastloop/map/landmark_arrays.hpp"

namespace fastloop::loop {

/// A place seen again: the pose of a keyframe in the world of another part of the map (or of
/// another map), and the landmarks it sees there.
struct RegionMatch {
  KeyframeId current, matched;
  bool merge = false;                 ///< `matched` lies in another map
  SE3 T_camera_world;                 ///< left camera of `current` in the world of `matched`
  std::vector<LandmarkId> landmarks;  ///< [keypoints of current] of the matched side; invalid: none
  int num_matches = 0;
  /// The landmarks around `matched`, where verification has gathered them already, and their copy on
  /// the device.
  std::shared_ptr<const map::LandmarkArrays> cloud;
  std::shared_ptr<const matching::ResidentLandmarks> resident;
};

}  // namespace fastloop::loop
