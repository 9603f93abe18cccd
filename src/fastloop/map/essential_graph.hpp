#pragma once

#include <vector>

#include "fastloop/map/map.hpp"
#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::map {

/// Two keyframes that see common landmarks since the loop was recognised.
struct LoopConnection {
  KeyframeId a, b;
  int shared = 0;  ///< landmarks in common after fusing
};

struct CorrectedPose {
  KeyframeId keyframe;
  SE3 T_world_body;
};

/// What is known of a loop when the graph is to be optimised. The map itself is still uncorrected.
struct ClosedLoop {
  LoopEdge edge;                            ///< as measured; always part of the graph
  std::vector<LoopConnection> connections;  ///< all pairs that became covisible through the loop
  std::vector<CorrectedPose> corrected;     ///< keyframes around the current one, moved by the loop
  KeyframeId fixed;                         ///< keyframe that stays, the matched one say
};

struct EssentialGraphOptions {
  optimization::PoseGraphKind kind = optimization::PoseGraphKind::kYaw;
  bool fixed_scale = true;  ///< kSim3 only
  int min_shared = 100;     ///< landmarks in common that make two keyframes neighbours
};

/// A map as a flat problem: every live keyframe of one map is a vertex, its pose T_world_body.
struct EssentialGraph {
  optimization::PoseGraphProblem problem;
  std::vector<KeyframeId> keyframe_of_vertex;  ///< ascending
  std::vector<int> vertex_of_keyframe;         ///< [keyframe slots] -1: not in the graph
};

/// Builds the graph of any kind. Edges, each pair once:
///   - the loop's edge as measured, and its connections with enough common landmarks, measured
///   between
///     corrected poses; these and the loops closed earlier are switchable
///   - loops closed earlier, neighbours in time, the spanning tree, and pairs with enough common
///     landmarks, measured between the poses of the snapshot
/// Neighbours in time are joined where IMU measurements lie between them. kYaw takes the spanning
/// tree only at keyframes without such a predecessor, and where the graph would fall apart without
/// it; the other kinds take the whole tree.
///
/// Edges are ordered by their later keyframe, so that the graph of a map that grew begins with that
/// of the map before, and a kept PoseGraphPlan is extended.
/// @param graph  overwritten; its memory is reused
/// @throws InvalidArgument when the loop names a keyframe that is not a live one of this map
void build_essential_graph(const Snapshot& snapshot, MapId map, const ClosedLoop& loop,
                           const EssentialGraphOptions& options, EssentialGraph& graph);

/// State of a vertex's keyframe after the solve: the velocity turns with the body, the bias stays.
NavState corrected_state(const Snapshot& snapshot, const EssentialGraph& graph, std::size_t vertex);

/// Moves every keyframe of the graph to where the solve put it. Landmarks and removed keyframes
/// follow, since they are stored relative to their anchors.
void take_back(const EssentialGraph& graph, Map& map);

}  // namespace fastloop::map
