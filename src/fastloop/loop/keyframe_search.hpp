#pragma once

#include <span>
#include <vector>

#include "fastloop/loop/step_executors.hpp"
#include "fastloop/map/landmark_arrays.hpp"

namespace fastloop::loop {

/// A keyframe where the loop puts it.
struct MovedKeyframe {
  KeyframeId keyframe;
  SE3 T_camera_world;  ///< left camera, corrected
};

/// Every landmark of a place searched in every keyframe, by the rule of loop closing: PS1 to PS3 and
/// loop fusion differ in radius and distance only.
/// @return [moved]
std::vector<matching::ProjectionMatches> search_keyframes(const StepExecutors& executors,
                                                          const map::Snapshot& snapshot,
                                                          std::span<const MovedKeyframe> moved,
                                                          const map::LandmarkArrays& cloud,
                                                          float radius_px, int max_distance);

/// The landmarks of a place and the keyframes to search them in.
struct PlaceSearch {
  const map::LandmarkArrays* cloud = nullptr;
  std::span<const MovedKeyframe> moved;
  /// The cloud on the device, once a search took place there; to be kept from search to search.
  std::shared_ptr<const matching::ResidentLandmarks>* resident = nullptr;
};

/// search_keyframes for several places at once, in one launch on the device.
/// @return the keyframes of all places, one after another
matching::MatchLists find_in_keyframes(const StepExecutors& executors,
                                       const map::Snapshot& snapshot,
                                       std::span<const PlaceSearch> places, float radius_px,
                                       int max_distance);

}  // namespace fastloop::loop
