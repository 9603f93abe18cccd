#pragma once

#include "fastloop/geometry/so3.hpp"

namespace fastloop {

/// Rigid transformation `T_a_b`: p_a = R * p_b + t.
///
/// Perturbation used by every optimiser of this project: with d = [d_phi, d_rho] (radians, metres),
///   T.retract(d) = (R * exp(d_phi), t + R * d_rho).
struct SE3 {
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  Vector3d translation = Vector3d::Zero();

  SE3() = default;
  SE3(const Eigen::Quaterniond& q, const Vector3d& t) : rotation(q.normalized()), translation(t) {}
  SE3(const Matrix3d& r, const Vector3d& t) : SE3(Eigen::Quaterniond(r), t) {}
  static SE3 from_matrix(const Eigen::Matrix4d& m) {
    return SE3(Matrix3d(m.topLeftCorner<3, 3>()), Vector3d(m.topRightCorner<3, 1>()));
  }

  SE3 inverse() const {
    const Eigen::Quaterniond r = rotation.conjugate();
    return SE3(r, -(r * translation));
  }
  SE3 operator*(const SE3& o) const {
    return SE3(rotation * o.rotation, rotation * o.translation + translation);
  }
  Vector3d operator*(const Vector3d& p) const { return rotation * p + translation; }

  Eigen::Matrix4d matrix() const {
    Eigen::Matrix4d m = Eigen::Matrix4d::Identity();
    m.topLeftCorner<3, 3>() = rotation.toRotationMatrix();
    m.topRightCorner<3, 1>() = translation;
    return m;
  }

  SE3 retract(const Vector6d& d) const {
    return SE3(rotation * so3::exp(d.head<3>()), translation + rotation * d.tail<3>());
  }
  /// Inverse of retract: a.retract(a.local(b)) == b.
  Vector6d local(const SE3& b) const {
    const Eigen::Quaterniond inv = rotation.conjugate();
    Vector6d d;
    d << so3::log(inv * b.rotation), inv * (b.translation - translation);
    return d;
  }

  bool is_finite() const { return rotation.coeffs().allFinite() && translation.allFinite(); }
};

/// Angle of the relative rotation, radians.
inline double angle_between(const SE3& a, const SE3& b) {
  return so3::log(a.rotation.conjugate() * b.rotation).norm();
}

}  // namespace fastloop
