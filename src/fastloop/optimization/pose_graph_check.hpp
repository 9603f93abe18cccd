#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::optimization {

/// Finite, positive scale, a unit quaternion.
bool is_valid_pose(const Sim3& pose);
/// What is wrong with the information matrices, or nothing.
std::optional<std::string> find_information_error(const PoseGraphProblem& problem);

/// Vertices that do not move in a solve, and why.
struct HeldVertices {
  std::vector<std::uint8_t> held;  ///< [n] fixed, anchor of its component, or without edges
  int components = 0;              ///< of vertices that have edges
  int anchored = 0;
};

/// Edges whose information is zero connect nothing.
void find_held_vertices(const PoseGraphProblem& problem, HeldVertices& result);

/// Is the information matrix (its top left residual_size x residual_size part) zero?
bool is_zero_information(const PoseGraphProblem& problem, const PoseGraphInformation& information);

}  // namespace fastloop::optimization
