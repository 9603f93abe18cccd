#pragma once

#include <vector>

#include "fastloop/matching/projection_search.hpp"
#include "fastloop/tracking/types.hpp"

namespace fastloop::tracking {

/// A keypoint of the present frame matched to a point of the last one.
struct PointMatch {
  std::uint32_t keypoint = 0;
  LandmarkId landmark;  ///< invalid for a stereo point of the last frame that is not in the map
  Vector3d p_world = Vector3d::Zero();
};

/// Landmarks of the last frame, and its close stereo points, searched around their projections at
/// the predicted pose.
std::vector<PointMatch> search_last_frame(const map::Snapshot& snapshot, const TrackedFrame& last,
                                          const FeatureSet& features,
                                          const SE3& predicted_T_world_body, float radius_px,
                                          float close_depth_m);

}  // namespace fastloop::tracking
