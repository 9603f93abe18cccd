#include "fastloop/loop/loop_correction.hpp"

#include <algorithm>

#include "fastloop/compute/worker_team.hpp"
#include "fastloop/loop/connections.hpp"
#include "fastloop/loop/landmark_update.hpp"
#include "fastloop/loop/verification.hpp"

namespace fastloop::loop {
namespace {

using map::LoopCorrection;
using map::Snapshot;

/// The current keyframe and all that see enough of what it sees.
std::vector<KeyframeId> connected_to(const Snapshot& snapshot, KeyframeId current, int min_shared) {
  std::vector<KeyframeId> ids{current};
  for (const map::CovisibilityEdge& e : snapshot.covisible(current))
    if (e.shared >= min_shared) ids.push_back(e.keyframe);
  return ids;
}

map::CorrectedState state_after(const Snapshot& snapshot, KeyframeId id, const SE3& T_new_old) {
  map::CorrectedState s;
  s.keyframe = id;
  s.before = s.after = snapshot.keyframe(id).state;
  s.after.T_world_body = T_new_old * s.before.T_world_body;
  s.after.v_world = T_new_old.rotation * s.before.v_world;
  return s;
}

/// The newer map moves into the frame of the older one.
void merge_rigidly(const Snapshot& snapshot, const RegionMatch& match, const SE3& T_new_old,
                   LoopCorrection& c) {
  const MapId current = snapshot.keyframe(match.current).map;
  const MapId matched = snapshot.keyframe(match.matched).map;
  c.kind = LoopCorrection::Kind::kMerge;
  c.map = std::min(current, matched);
  c.merged = std::max(current, matched);
  const SE3 motion = c.merged == current ? T_new_old : T_new_old.inverse();
  for (std::uint32_t i = 0; i < snapshot.keyframe_slots(); ++i)
    if (snapshot.contains(KeyframeId(i)) && snapshot.keyframe(KeyframeId(i)).map == c.merged)
      c.states.push_back(state_after(snapshot, KeyframeId(i), motion));
}

/// The published solver differentiates by steps of 1e-9, and so stops up to centimetres beside the
/// minimum when the graph has thousands of keyframes, however often it is called. One with exact
/// derivatives, and not the one it is compared with, goes the rest of the way.
void finish_exactly(optimization::PoseGraphProblem& problem) {
  optimization::PoseGraphOptions exact;
  exact.solver = optimization::PoseGraphSolverKind::kCeres;
  exact.relative_tolerance = 1e-14;
  optimization::solve_pose_graph(problem, exact);
}

/// The solver for a graph of this size.
optimization::PoseGraphSolverKind solver_for(const StepExecutors& executors,
                                             const optimization::PoseGraphProblem& problem) {
  if (executors.reference()) return optimization::PoseGraphSolverKind::kReference;
  const double unknowns = (problem.kind == optimization::PoseGraphKind::kYaw ? 4.0 : 6.0) *
                          static_cast<double>(problem.poses.size());
  return executors.of(Step::kPoseGraph, unknowns).cuda_session()
             ? optimization::PoseGraphSolverKind::kCuda
             : optimization::PoseGraphSolverKind::kBlock;
}

void optimise_graph(const Snapshot& snapshot, const LoopOptions& options,
                    const StepExecutors& executors,
                    map::ClosedLoop loop, CorrectionMemory& memory, StageClock& clock,
                    LoopCorrection& c) {
  map::EssentialGraphOptions graph;
  graph.kind = options.inertial ? optimization::PoseGraphKind::kYaw
                                : optimization::PoseGraphKind::kSim3;
  graph.fixed_scale = true;
  graph.min_shared = options.graph_min_connection;
  map::build_essential_graph(snapshot, c.map, loop, graph, memory.graph);
  clock.lap("graph_build");
  optimization::PoseGraphOptions solve;
  solve.solver = solver_for(executors, memory.graph.problem);
  solve.relative_tolerance = 1e-14;  // 1e-10 leaves poses of 3,000 keyframes 1e-5 m away
  solve.threads = executors.reference() ? 1 : options.graph_threads;
  {
    const WorkerTeam::Rest rest;  // the solver has workers of its own
    optimization::solve_pose_graph(memory.graph.problem, solve, &memory.plan, memory.graph_result);
  }
  for (std::size_t v = 0; v < memory.graph.keyframe_of_vertex.size(); ++v) {
    const KeyframeId id = memory.graph.keyframe_of_vertex[v];
    c.states.push_back({id, snapshot.keyframe(id).state,
                        map::corrected_state(snapshot, memory.graph, v)});
  }
  clock.lap("graph_solve");
  if (!executors.reference()) return;
  finish_exactly(memory.graph.problem);
  for (std::size_t v = 0; v < c.states.size(); ++v)
    c.states[v].after = map::corrected_state(snapshot, memory.graph, v);
  clock.lap("graph_finish");
}

}  // namespace

LoopCorrection compute_correction(const Snapshot& snapshot, const RegionMatch& match,
                                  const LoopOptions& options, const StepExecutors& executors,
                                  CorrectionMemory& memory, StageClock& clock) {
  LoopCorrection c;
  c.frame_version = snapshot.frame_version();
  c.map = snapshot.keyframe(match.current).map;
  const SE3 T_world_body_new =
      match.T_camera_world.inverse() * snapshot.rig().T_body_left.inverse();
  const SE3 T_new_old = T_world_body_new * snapshot.T_world_body(match.current).inverse();
  c.edge = {match.matched, match.current,
            snapshot.T_world_body(match.matched).inverse() * T_world_body_new};

  const std::vector<KeyframeId> connected =
      connected_to(snapshot, match.current, options.min_connection);
  std::vector<MovedKeyframe> moved;
  map::ClosedLoop loop{c.edge, {}, {}, match.matched};
  for (const KeyframeId id : connected) {
    const SE3 T_world_body = T_new_old * snapshot.T_world_body(id);
    moved.push_back({id, (T_world_body * snapshot.rig().T_body_left).inverse()});
    loop.corrected.push_back({id, T_world_body});
  }
  clock.lap("correct_poses");

  std::shared_ptr<const map::LandmarkArrays> cloud = match.cloud;
  if (!cloud)
    cloud = std::make_shared<map::LandmarkArrays>(
        snapshot,
        map::landmarks_of(snapshot, window_of(snapshot, match.matched, options.window_covisibles)),
        executors.host());
  Fusion fusion = fuse_loop(executors, snapshot, options, match, moved, *cloud);
  clock.lap("loop_fusion");
  if (match.merge) {
    merge_rigidly(snapshot, match, T_new_old, c);
  } else {
    loop.connections = executors.reference()
                           ? find_connections_reference(snapshot, connected, fusion,
                                                        options.min_connection)
                           : find_connections(snapshot, connected, fusion, options.min_connection);
    clock.lap("connections");
    optimise_graph(snapshot, options, executors, std::move(loop), memory, clock, c);
  }
  c.merges = std::move(fusion.merges);
  c.observations = std::move(fusion.observations);
  if (executors.reference()) {
    move_landmarks_reference(snapshot, c.states);
    clock.lap("landmarks");
  }
  return c;
}

}  // namespace fastloop::loop
