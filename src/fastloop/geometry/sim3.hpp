#pragma once

#include <cmath>
#include <complex>

#include "fastloop/geometry/se3.hpp"

namespace fastloop {

using Vector7d = Eigen::Matrix<double, 7, 1>;
using Matrix7d = Eigen::Matrix<double, 7, 7>;

/// Similarity transformation `S_a_b`: p_a = scale * R * p_b + t, scale > 0.
///
/// Tangent vectors are [phi, rho, sigma]: rotation vector (radians), translation part (metres), log(scale).
///   exp(phi, rho, sigma) = (exp(phi), W rho, e^sigma),   W = integral over s in [0, 1] of exp(s (hat(phi) + sigma I)).
struct Sim3 {
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  Vector3d translation = Vector3d::Zero();
  double scale = 1;

  Sim3() = default;
  Sim3(const Eigen::Quaterniond& q, const Vector3d& t, double s)
      : rotation(q.normalized()), translation(t), scale(s) {}
  explicit Sim3(const SE3& pose) : rotation(pose.rotation), translation(pose.translation) {}

  /// Drops the scale: the pose of the same frame in the same place.
  SE3 rigid() const { return SE3(rotation, translation); }

  Sim3 inverse() const {
    const Eigen::Quaterniond r = rotation.conjugate();
    return Sim3(r, -(r * translation) / scale, 1 / scale);
  }
  Sim3 operator*(const Sim3& o) const {
    return Sim3(rotation * o.rotation, scale * (rotation * o.translation) + translation,
                scale * o.scale);
  }
  Vector3d operator*(const Vector3d& p) const { return scale * (rotation * p) + translation; }

  bool is_finite() const {
    return rotation.coeffs().allFinite() && translation.allFinite() && std::isfinite(scale);
  }

  static Sim3 exp(const Vector7d& d);
  /// Inverse of exp; the rotation vector has norm in [0, pi].
  Vector7d log() const;
  /// this * exp(d) == exp(adjoint() * d) * this
  Matrix7d adjoint() const;
};

namespace sim3 {

/// f(hat(phi) + sigma I) = c I + a hat(phi) + b hat(phi)^2 for an analytic f with real coefficients.
struct MatrixFunction {
  double c = 0, a = 0, b = 0;
  Matrix3d operator()(const Vector3d& phi) const {
    const Matrix3d w = so3::hat(phi);
    return c * Matrix3d::Identity() + a * w + b * w * w;
  }
};

/// f(x) = (e^x - 1) / x: the matrix W of exp. The power series has no cancellation near zero; the closed form
/// takes over where the series would be long.
inline MatrixFunction exp_integral(double theta_sq, double sigma) {
  MatrixFunction f;
  if (theta_sq + sigma * sigma < 16) {
    // (sigma + i theta)^k = u + i theta v, and w = (sigma^k - u) / theta^2, by recurrence.
    double s = 1, u = 1, v = 0, w = 0, coefficient = 1;
    for (int k = 0; k < 60; ++k) {
      coefficient /= k + 1;
      f.c += coefficient * s;
      f.a += coefficient * v;
      f.b += coefficient * w;
      if (coefficient * (std::abs(s) + std::abs(u) + std::abs(v) + std::abs(w)) < 1e-18) break;
      w = sigma * w + v;
      const double next = sigma * u - theta_sq * v;
      v = u + sigma * v;
      u = next;
      s *= sigma;
    }
    return f;
  }
  const double theta = std::sqrt(theta_sq);
  const std::complex<double> z(sigma, theta);
  const std::complex<double> value = (std::exp(z) - 1.0) / z;
  f.c = std::abs(sigma) < 1e-8 ? 1.0 + 0.5 * sigma : std::expm1(sigma) / sigma;
  if (theta > 1e-6) {
    f.a = value.imag() / theta;
    f.b = (f.c - value.real()) / theta_sq;
  }
  return f;
}

/// 1 / f of the function above, as a matrix function: the inverse of W.
inline MatrixFunction inverse(const MatrixFunction& f, double theta_sq) {
  const double p = f.c - f.b * theta_sq;
  const double d = p * p + f.a * f.a * theta_sq;
  return {1 / f.c, -f.a / d, (f.a * f.a - f.b * p) / (f.c * d)};
}

/// Matrix of the Lie bracket: adjoint_algebra(x) * y = [x, y].
inline Matrix7d adjoint_algebra(const Vector7d& x) {
  Matrix7d m = Matrix7d::Zero();
  const Matrix3d w = so3::hat(x.head<3>());
  m.block<3, 3>(0, 0) = w;
  m.block<3, 3>(3, 0) = so3::hat(x.segment<3>(3));
  m.block<3, 3>(3, 3) = w + x[6] * Matrix3d::Identity();
  m.block<3, 1>(3, 6) = -x.segment<3>(3);
  return m;
}

/// Inverse of the right Jacobian: log(exp(x) * exp(d)) = x + right_jacobian_inverse(x) * d to first order.
/// The right Jacobian itself is an everywhere convergent series of the bracket; it is summed and inverted.
inline Matrix7d right_jacobian_inverse(const Vector7d& x) {
  const Matrix7d bracket = -adjoint_algebra(x);
  Matrix7d term = Matrix7d::Identity(), sum = term;
  for (int k = 1; k < 80; ++k) {
    term = (term * bracket / (k + 1)).eval();
    sum += term;
    if (term.cwiseAbs().maxCoeff() < 1e-18) break;
  }
  return sum.partialPivLu().inverse();
}

}  // namespace sim3

inline Sim3 Sim3::exp(const Vector7d& d) {
  const Vector3d phi = d.head<3>();
  const sim3::MatrixFunction w = sim3::exp_integral(phi.squaredNorm(), d[6]);
  const Vector3d rho = d.segment<3>(3), cross = phi.cross(rho);
  return Sim3(so3::exp(phi), w.c * rho + w.a * cross + w.b * phi.cross(cross), std::exp(d[6]));
}

inline Vector7d Sim3::log() const {
  const Vector3d phi = so3::log(rotation);
  const double sigma = std::log(scale), theta_sq = phi.squaredNorm();
  const sim3::MatrixFunction w =
      sim3::inverse(sim3::exp_integral(theta_sq, sigma), theta_sq);
  const Vector3d cross = phi.cross(translation);
  Vector7d d;
  d << phi, w.c * translation + w.a * cross + w.b * phi.cross(cross), sigma;
  return d;
}

inline Matrix7d Sim3::adjoint() const {
  const Matrix3d r = rotation.toRotationMatrix();
  Matrix7d m = Matrix7d::Zero();
  m.block<3, 3>(0, 0) = r;
  m.block<3, 3>(3, 0) = so3::hat(translation) * r;
  m.block<3, 3>(3, 3) = scale * r;
  m.block<3, 1>(3, 6) = -translation;
  m(6, 6) = 1;
  return m;
}

}  // namespace fastloop
