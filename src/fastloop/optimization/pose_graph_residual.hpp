#pragma once

#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::optimization {

/// Number of unknowns of a vertex and of residuals of an edge.
inline int tangent_size(PoseGraphKind kind, bool fixed_scale) {
  return kind == PoseGraphKind::kYaw ? 4 : kind == PoseGraphKind::kSim3 && !fixed_scale ? 7 : 6;
}
inline int residual_size(PoseGraphKind kind) {
  return kind == PoseGraphKind::kSim3 ? 7 : 6;
}

/// Residual of one edge and its derivative, written for clarity; the block solver's vector code
/// must agree with it.
///
/// Vertices are moved in the world frame: X <- exp(d) X with d = [phi, rho, sigma], and for kYaw
/// X <- (Rz(psi), t) X with d = [psi, t]. Both ends then have opposite derivatives: J_from = -J_to.
/// kYaw and kSe3 take the exponential of the rotation and the linear part of the translation, t +
/// phi x t + rho: their translation residual is linear in the positions, and steps land closer to
/// the minimum (measured: one iteration less). kSim3 takes the exponential of the group, which is
/// better there.
struct EdgeLinearization {
  Vector7d residual = Vector7d::Zero();     ///< rows beyond residual_size are zero
  Matrix7d jacobian_to = Matrix7d::Zero();  ///< columns beyond tangent_size are zero
};

Vector7d edge_residual(PoseGraphKind kind, const Sim3& from, const Sim3& to, const Sim3& T_from_to);
EdgeLinearization linearize_edge(PoseGraphKind kind, const Sim3& from, const Sim3& to,
                                 const Sim3& T_from_to);

/// Moves a vertex in the world frame by d, of which tangent_size numbers count.
Sim3 move_vertex(PoseGraphKind kind, const Sim3& pose, const Vector7d& d);

/// Robust cost rho(s) of a squared residual s and its derivative.
struct RobustValue {
  double cost, weight;
};
RobustValue evaluate_robust_kernel(RobustKernel kernel, double width, double squared);

}  // namespace fastloop::optimization
