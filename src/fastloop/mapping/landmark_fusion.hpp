#pragma once

#include "fastloop/map/map.hpp"
#include "fastloop/mapping/options.hpp"

namespace fastloop::mapping {

/// Finds the landmarks of a keyframe in its neighbours (and theirs in it) by projection; adds
/// observations and merges duplicates. Returns the number of changes.
int fuse_with_neighbours(map::Map& map, KeyframeId keyframe, const MappingOptions& options);

}  // namespace fastloop::mapping
