#pragma once

#include <vector>

#include "fastloop/map/correction.hpp"

namespace fastloop::loop {

/// World position and normal of one landmark after a correction.
struct MovedLandmark {
  LandmarkId landmark;
  Vector3d p_world = Vector3d::Zero();
  Vector3d normal_world = Vector3d::Zero();
  double min_distance_m = 0, max_distance_m = 0;
};

/// The published way to make landmarks follow a correction: each one through the keyframe it is
/// anchored in, then its viewing direction and range anew from all observations. The map does not
/// need it, for its landmarks are stored relative to their anchors; it is part of the reference back
/// end, and the oracle for the anchored way.
std::vector<MovedLandmark> move_landmarks_reference(const map::Snapshot& snapshot,
                                                    const std::vector<map::CorrectedState>& states);

}  // namespace fastloop::loop
