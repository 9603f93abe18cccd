#pragma once

#include "fastloop/loop/fusion.hpp"
#include "fastloop/loop/stage_clock.hpp"
#include "fastloop/map/correction.hpp"
#include "fastloop/map/essential_graph.hpp"

namespace fastloop::loop {

/// Work memory that a sequence of corrections shares: the order of elimination of the pose graph is
/// kept from loop to loop.
struct CorrectionMemory {
  map::EssentialGraph graph;
  optimization::PoseGraphPlan plan;
  optimization::PoseGraphResult graph_result;
};

/// What a verified match changes in the map: connected keyframes through the correction, loop fusion,
/// new connections, pose graph (4-DoF where gravity is known, SE3 otherwise); for a merge the whole
/// map that is newer moves rigidly instead.
/// Stages: "correct_poses", "loop_fusion", "connections", "graph_build", "graph_solve"; with the
/// reference back end only "graph_finish", which takes the published solver's poses to the very
/// minimum, where those of all back ends agree to 1e-6 (no part of the published method), and
/// "landmarks", which moves every landmark as published.
map::LoopCorrection compute_correction(const map::Snapshot& snapshot, const RegionMatch& match,
                                       const LoopOptions& options, const StepExecutors& executors,
                                       CorrectionMemory& memory, StageClock& clock);

}  // namespace fastloop::loop
