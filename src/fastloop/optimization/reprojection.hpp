#pragma once

#include <cstdint>
#include <span>

#include "fastloop/optimization/pose_only.hpp"

/// Reprojection errors of one frame with known landmarks, shared by the pose optimisers.
namespace fastloop::optimization {

/// Normal equations at one pose. Perturbation: T_world_left.retract([phi, rho]).
struct ReprojectionTerms {
  Matrix6d hessian = Matrix6d::Zero();
  Vector6d gradient = Vector6d::Zero();  ///< of half the cost
  double cost = 0;                       ///< sum of rho(normalised squared residual)
};

/// Cost charged for an active observation whose point cannot be projected, in multiples of its
/// gate. It keeps a step from paying off by moving points behind the camera.
inline constexpr double kBehindCameraPenalty = 4.0;

/// True when every number of the observation can be used.
bool is_usable(const StereoRig& rig, const PoseObservation& observation);

/// Sums the terms of the active observations in their order.
/// @param active  [observations]
/// @param robust  Huber kernel at sqrt(chi2_gate)
ReprojectionTerms accumulate_reprojection(const StereoRig& rig, const SE3& T_left_world,
                                          std::span<const PoseObservation> observations,
                                          std::span<const std::uint8_t> active, bool robust);

/// Marks the usable observations that pass `gate_scale * chi2_gate` at this pose.
/// @param usable        [observations]
/// @param[out] inlier   [observations]
/// @return number of inliers
int classify_by_gate(const StereoRig& rig, const SE3& T_left_world,
                     std::span<const PoseObservation> observations,
                     std::span<const std::uint8_t> usable, double gate_scale,
                     std::span<std::uint8_t> inlier);

/// The same terms about a perturbation of T_world_body, where T_world_left = T_world_body *
/// T_body_left.
ReprojectionTerms in_body_frame(const ReprojectionTerms& left, const SE3& T_body_left);

}  // namespace fastloop::optimization
