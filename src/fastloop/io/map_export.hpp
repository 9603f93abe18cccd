#pragma once

#include <filesystem>

#include "fastloop/io/g2o.hpp"
#include "fastloop/map/snapshot.hpp"

namespace fastloop::io {

/// Landmarks (grey) and positions of the live keyframes (one colour a map) as a point cloud.
/// @throws InputError when the file cannot be written
void export_map_ply(const std::filesystem::path& path, const map::Snapshot& map);

/// The essential graph: a vertex of its keyframe's id for every live keyframe, its pose
/// T_world_body; edges between parents and children of the spanning tree, keyframes that share at
/// least `min_shared` landmarks (both measured from the present poses), and loops as they were
/// measured (switchable). The first keyframe of each map is fixed.
G2oGraph essential_g2o(const map::Snapshot& map, int min_shared = 100);

}  // namespace fastloop::io
