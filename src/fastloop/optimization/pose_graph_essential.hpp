#pragma once

#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::optimization {

/// The edges of an essential graph as indices of keyframes, whatever the map looks like.
struct EssentialGraph {
  std::vector<std::pair<int, int>> chain;         ///< consecutive keyframes
  std::vector<std::pair<int, int>> parent;        ///< child, parent of the spanning tree
  std::vector<std::pair<int, int>> covisible;     ///< pairs above the weight threshold
  std::vector<std::pair<int, int>> old_loops;     ///< loops closed earlier
  std::vector<std::pair<int, int>> new_loops;     ///< of the loop being closed
};

/// Builds the flat problem of any kind. Measurements come from `uncorrected`, those of new loops from `corrected`;
/// start values are `corrected`. A pair named more than once, in either direction, gives one edge; new loops win.
/// Loop edges are switchable. Information: published_yaw_information() for kYaw, identity otherwise.
/// @param fixed  keyframe that is held; -1: none
/// @throws InvalidArgument on unequal lengths, or indices out of range
PoseGraphProblem build_essential_graph_problem(PoseGraphKind kind, bool fixed_scale,
                                               std::span<const Sim3> uncorrected,
                                               std::span<const Sim3> corrected, const EssentialGraph& graph,
                                               int fixed);

}  // namespace fastloop::optimization
