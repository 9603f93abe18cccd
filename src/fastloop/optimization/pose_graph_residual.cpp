#include "fastloop/optimization/pose_graph_residual.hpp"

#include <cmath>

namespace fastloop::optimization {
namespace {

Vector3d log_of_rotation_residual(const Sim3& from, const Sim3& to, const Sim3& z) {
  return so3::log(from.rotation.conjugate() * to.rotation * z.rotation.conjugate());
}

Sim3 error_element(const Sim3& from, const Sim3& to, const Sim3& z) {
  return z.inverse() * (from.inverse() * to);
}

}  // namespace

Vector7d edge_residual(PoseGraphKind kind, const Sim3& from, const Sim3& to, const Sim3& z) {
  Vector7d r = Vector7d::Zero();
  if (kind == PoseGraphKind::kSim3) return error_element(from, to, z).log();
  if (kind == PoseGraphKind::kYaw) {
    r.head<3>() = log_of_rotation_residual(from, to, z);
    r.segment<3>(3) =
        from.rotation.conjugate() * (to.translation - from.translation) - z.translation;
    return r;
  }
  const Sim3 e = error_element(from, to, z);
  r.head<3>() = e.rotation.w() < 0 ? Vector3d(-e.rotation.vec()) : Vector3d(e.rotation.vec());
  r.segment<3>(3) = e.translation;
  return r;
}

EdgeLinearization linearize_edge(PoseGraphKind kind, const Sim3& from, const Sim3& to,
                                 const Sim3& z) {
  EdgeLinearization out;
  out.residual = edge_residual(kind, from, to, z);
  if (kind == PoseGraphKind::kSim3) {
    out.jacobian_to = sim3::right_jacobian_inverse(out.residual) * to.inverse().adjoint();
  } else if (kind == PoseGraphKind::kYaw) {
    const Matrix3d r_from_world = from.rotation.conjugate().toRotationMatrix();
    // The rotation residual is moved from the left by the gravity axis seen from `from`.
    const Vector3d phi = out.residual.head<3>();
    out.jacobian_to.block<3, 1>(0, 0) =
        so3::right_jacobian_inverse(-phi) * r_from_world * Vector3d::UnitZ();
    out.jacobian_to.block<3, 1>(3, 0) = r_from_world * Vector3d::UnitZ().cross(to.translation);
    out.jacobian_to.block<3, 3>(3, 1) = r_from_world;
  } else {
    const Sim3 e = error_element(from, to, z);
    const double sign = e.rotation.w() < 0 ? -1.0 : 1.0;
    Matrix7d local = Matrix7d::Zero();
    local.block<3, 3>(0, 0) =
        0.5 * sign * (e.rotation.w() * Matrix3d::Identity() + so3::hat(e.rotation.vec()));
    local.block<3, 3>(3, 3) = e.rotation.toRotationMatrix();
    out.jacobian_to = local * to.inverse().adjoint();
    out.jacobian_to.col(6).setZero();
  }
  return out;
}

Sim3 move_vertex(PoseGraphKind kind, const Sim3& pose, const Vector7d& d) {
  if (kind == PoseGraphKind::kYaw) {
    const Eigen::Quaterniond yaw = so3::exp(Vector3d(0, 0, d[0]));
    return Sim3(
        yaw * pose.rotation,
        pose.translation + d[0] * Vector3d::UnitZ().cross(pose.translation) + d.segment<3>(1),
        pose.scale);
  }
  if (kind == PoseGraphKind::kSe3)
    return Sim3(so3::exp(d.head<3>()) * pose.rotation,
                pose.translation + d.head<3>().cross(pose.translation) + d.segment<3>(3),
                pose.scale);
  return Sim3::exp(d) * pose;
}

RobustValue evaluate_robust_kernel(RobustKernel kernel, double width, double squared) {
  const double width_sq = width * width;
  switch (kernel) {
    case RobustKernel::kNone:
      break;
    case RobustKernel::kHuber:
      if (squared > width_sq) {
        const double root = std::sqrt(squared);
        return {2 * width * root - width_sq, width / root};
      }
      break;
    case RobustKernel::kCauchy:
      return {width_sq * std::log1p(squared / width_sq), 1 / (1 + squared / width_sq)};
    case RobustKernel::kDynamicCovarianceScaling:
      if (squared > width_sq) {
        const double scale = 2 * width_sq / (width_sq + squared);
        return {width_sq * (3 * squared - width_sq) / (width_sq + squared), scale * scale};
      }
      break;
  }
  return {squared, 1};
}

}  // namespace fastloop::optimization
