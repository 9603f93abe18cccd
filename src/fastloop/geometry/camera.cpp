#include "fastloop/geometry/camera.hpp"

#include <cmath>

namespace fastloop {
namespace {

constexpr double kMinDepth = 1e-9;

struct Distorted {
  Eigen::Vector2d point;
  Eigen::Matrix2d jacobian;
};

/// Radial-tangential distortion of a point of the normalised image plane, with its derivative.
Distorted distort_radtan(const Camera& c, double x, double y) {
  const auto [k1, k2, p1, p2, k3] = c.distortion;
  const double r2 = x * x + y * y;
  const double radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  const double d_radial = k1 + r2 * (2 * k2 + 3 * k3 * r2);  // d radial / d r2
  Distorted d;
  d.point << x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
      y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y;
  d.jacobian << radial + 2 * x * x * d_radial + 2 * p1 * y + 6 * p2 * x,
      2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y,
      2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y,
      radial + 2 * y * y * d_radial + 6 * p1 * y + 2 * p2 * x;
  return d;
}

/// theta_d(theta) of the Kannala-Brandt model and its derivative.
std::pair<double, double> kannala_brandt(const Camera& c, double theta) {
  const double t2 = theta * theta;
  const auto& k = c.distortion;
  const double value = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
  const double slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])));
  return {value, slope};
}

}  // namespace

bool Camera::is_ideal_pinhole() const {
  if (model != CameraModel::kPinhole) return false;
  for (const double d : distortion)
    if (d != 0) return false;
  return true;
}

Eigen::Vector2d Camera::project(const Vector3d& p, Eigen::Matrix<double, 2, 3>* jacobian) const {
  if (model == CameraModel::kPinhole) {
    const double iz = 1.0 / p.z();
    const double x = p.x() * iz, y = p.y() * iz;
    if (is_ideal_pinhole()) {
      if (jacobian) *jacobian << fx * iz, 0, -fx * x * iz, 0, fy * iz, -fy * y * iz;
      return {fx * x + cx, fy * y + cy};
    }
    const Distorted d = distort_radtan(*this, x, y);
    if (jacobian) {
      Eigen::Matrix<double, 2, 3> normalise;
      normalise << iz, 0, -x * iz, 0, iz, -y * iz;
      *jacobian = Eigen::Vector2d(fx, fy).asDiagonal() * d.jacobian * normalise;
    }
    return {fx * d.point.x() + cx, fy * d.point.y() + cy};
  }
  const double r2 = p.x() * p.x() + p.y() * p.y();
  const double r = std::sqrt(r2);
  const double theta = std::atan2(r, p.z());
  const auto [theta_d, slope] = kannala_brandt(*this, theta);
  if (r < 1e-12) {
    if (jacobian) {
      jacobian->setZero();
      (*jacobian)(0, 0) = fx / p.z();
      (*jacobian)(1, 1) = fy / p.z();
    }
    return {cx, cy};
  }
  const double s = theta_d / r;
  if (jacobian) {
    const double n2 = r2 + p.z() * p.z();
    const double d_theta_r = p.z() / n2;  // d theta / d r
    const double d_theta_z = -r / n2;     // d theta / d z
    const double ds_r = (slope * d_theta_r - s) / r;
    const double ux = p.x() / r, uy = p.y() / r;
    (*jacobian) << fx * (s + p.x() * ds_r * ux), fx * p.x() * ds_r * uy,
        fx * slope * d_theta_z * ux, fy * p.y() * ds_r * ux, fy * (s + p.y() * ds_r * uy),
        fy * slope * d_theta_z * uy;
  }
  return {fx * s * p.x() + cx, fy * s * p.y() + cy};
}

bool Camera::is_projectable(const Vector3d& p) const {
  if (model == CameraModel::kPinhole) return p.z() > kMinDepth;
  const double r = std::hypot(p.x(), p.y());
  const double theta = std::atan2(r, p.z());
  return p.squaredNorm() > kMinDepth * kMinDepth && theta < 0.98 * M_PI &&
         kannala_brandt(*this, theta).second > 0;
}

Vector3d Camera::unproject(const Eigen::Vector2d& pixel) const {
  const Eigen::Vector2d target((pixel.x() - cx) / fx, (pixel.y() - cy) / fy);
  if (model == CameraModel::kPinhole) {
    Eigen::Vector2d p = target;
    if (!is_ideal_pinhole()) {
      for (int i = 0; i < 20; ++i) {
        const Distorted d = distort_radtan(*this, p.x(), p.y());
        const Eigen::Vector2d step = d.jacobian.inverse() * (target - d.point);
        p += step;
        if (step.squaredNorm() < 1e-24) break;
      }
    }
    return Vector3d(p.x(), p.y(), 1).normalized();
  }
  const double theta_d = target.norm();
  if (theta_d < 1e-12) return Vector3d::UnitZ();
  double theta = std::min(theta_d, M_PI);
  for (int i = 0; i < 20; ++i) {
    const auto [value, slope] = kannala_brandt(*this, theta);
    const double step = (theta_d - value) / slope;
    theta += step;
    if (std::abs(step) < 1e-13) break;
  }
  const double s = std::sin(theta) / theta_d;
  return {s * target.x(), s * target.y(), std::cos(theta)};
}

std::optional<std::string> Camera::problem() const {
  if (width <= 0 || height <= 0) return "image size must be positive";
  for (const double v : {fx, fy, cx, cy})
    if (!std::isfinite(v)) return "intrinsics must be finite";
  if (fx <= 0 || fy <= 0) return "focal lengths must be positive";
  for (const double d : distortion)
    if (!std::isfinite(d)) return "distortion must be finite";
  return std::nullopt;
}

}  // namespace fastloop
