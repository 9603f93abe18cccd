#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

namespace fastloop {

using Vector3d = Eigen::Vector3d;
using Matrix3d = Eigen::Matrix3d;
using Vector6d = Eigen::Matrix<double, 6, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

/// The rotation group SO(3). Rotation vectors in radians; perturbations are on the right: R * exp(phi).
namespace so3 {

inline Matrix3d hat(const Vector3d& v) {
  Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

inline Eigen::Quaterniond exp(const Vector3d& phi) {
  const double theta_sq = phi.squaredNorm();
  double real, scale;
  if (theta_sq < 1e-12) {
    real = 1.0 - theta_sq / 8.0;
    scale = 0.5 - theta_sq / 48.0;
  } else {
    const double theta = std::sqrt(theta_sq);
    real = std::cos(0.5 * theta);
    scale = std::sin(0.5 * theta) / theta;
  }
  return Eigen::Quaterniond(real, scale * phi.x(), scale * phi.y(), scale * phi.z()).normalized();
}

/// Rotation vector with norm in [0, pi].
inline Vector3d log(const Eigen::Quaterniond& q) {
  const double sign = q.w() < 0 ? -1.0 : 1.0;
  const double w = sign * q.w();
  const Vector3d v = sign * q.vec();
  const double n = v.norm();
  if (n < 1e-9) return (2.0 / w) * (1.0 - n * n / (3.0 * w * w)) * v;
  return (2.0 * std::atan2(n, w) / n) * v;
}

/// Right Jacobian: exp(phi + d) = exp(phi) * exp(Jr(phi) d) to first order.
inline Matrix3d right_jacobian(const Vector3d& phi) {
  const double theta_sq = phi.squaredNorm();
  const Matrix3d w = hat(phi);
  if (theta_sq < 1e-10) return Matrix3d::Identity() - 0.5 * w + w * w / 6.0;
  const double theta = std::sqrt(theta_sq);
  return Matrix3d::Identity() - (1.0 - std::cos(theta)) / theta_sq * w +
         (theta - std::sin(theta)) / (theta_sq * theta) * w * w;
}

/// Inverse of the right Jacobian; valid for |phi| < 2 pi.
inline Matrix3d right_jacobian_inverse(const Vector3d& phi) {
  const double theta_sq = phi.squaredNorm();
  const Matrix3d w = hat(phi);
  if (theta_sq < 1e-10) return Matrix3d::Identity() + 0.5 * w + w * w / 12.0;
  const double theta = std::sqrt(theta_sq);
  const double k = 1.0 / theta_sq - (1.0 + std::cos(theta)) / (2.0 * theta * std::sin(theta));
  return Matrix3d::Identity() + 0.5 * w + k * w * w;
}

}  // namespace so3
}  // namespace fastloop
