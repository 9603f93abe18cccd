#pragma once

#include <vector>

#include "fastloop/map/map.hpp"
#include "fastloop/mapping/options.hpp"

namespace fastloop::mapping {

/// Landmarks from the stereo or depth of one keyframe: all close points, and the nearest of the
/// others until there are enough. Returns the new ids.
std::vector<LandmarkId> create_from_stereo(map::Map& map, KeyframeId keyframe,
                                           const MappingOptions& options);

/// Landmarks by triangulation of keypoints without landmark between the keyframe and its best
/// covisible neighbours. Returns the new ids.
std::vector<LandmarkId> create_by_triangulation(map::Map& map, KeyframeId keyframe,
                                                const MappingOptions& options);

}  // namespace fastloop::mapping
