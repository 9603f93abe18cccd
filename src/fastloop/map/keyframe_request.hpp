#pragma once

#include <memory>
#include <string>
#include <vector>

#include "fastloop/map/entities.hpp"

namespace fastloop::map {

/// How often tracking predicted a landmark in view, and how often it found it, since the last
/// request.
struct Sighting {
  LandmarkId landmark;
  std::uint32_t visible = 0, found = 0;
};

/// What tracking hands to mapping: a frame that should become a keyframe. Requests are processed in
/// order, each becomes a keyframe, so the sender knows the id it will get.
struct KeyframeRequest {
  KeyframeId id;  ///< of the keyframe this becomes: the next free slot
  std::shared_ptr<const KeyframeData> data;
  NavState state;        ///< as tracked
  KeyframeId reference;  ///< keyframe that the pose is relative to; invalid for a new map
  SE3 T_reference_body;
  std::vector<LandmarkId> landmarks;  ///< [num_keypoints] matches, possibly stale
  std::shared_ptr<const PreintegratedImu>
      imu_from_previous;  ///< from the previous keyframe of this map
  bool starts_map = false;
  std::vector<Sighting> sightings;  ///< ordered by landmark id
};

}  // namespace fastloop::map
