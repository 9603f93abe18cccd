#pragma once

#include <cstdint>
#include <string>

#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::sim {

/// Shape of the way through the world.
enum class PoseGraphShape : int {
  kLoop,    ///< one big loop, closed at the end
  kLaps,    ///< four laps of one circuit
  kCity,    ///< wandering through a grid of streets
  kCampus,  ///< several circuits through one common place, each walked twice
};

struct PoseGraphWorldOptions {
  PoseGraphShape shape = PoseGraphShape::kLoop;
  int poses = 1000;        ///< >= 30
  int dof = 4;             ///< 4 (yaw and translation), 6 (SE3) or 7 (Sim3)
  std::uint64_t seed = 1;
  void validate() const;   ///< throws InvalidArgument
};

/// "loop", "laps", "city", "campus"; throws InvalidArgument on anything else.
PoseGraphShape pose_graph_shape(const std::string& name);

/// The essential graph of a SLAM system at the moment in which it closes a loop: keyframes 0.7 m apart, each joined to
/// some of the keyframes before it (5 edges a keyframe) and, where the way was walked before, to up to three old ones.
/// The last stretch has drifted; the last ten keyframes have just been corrected through a handful of loop edges
/// (marked switchable). As in ORB-SLAM3, ordinary measurements are what the uncorrected estimate says, loop edges what
/// the corrected one says. Keyframe 0 is fixed.
struct PoseGraphWorld {
  optimization::PoseGraphProblem problem;
  std::vector<Sim3> truth;  ///< [n] true poses
};
PoseGraphWorld make_pose_graph_world(const PoseGraphWorldOptions& options);

}  // namespace fastloop::sim
