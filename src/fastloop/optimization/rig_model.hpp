#pragma once

#include <cmath>

#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop::optimization {

/// StereoRig::residual for inner loops: the same values, with the two usual rigs (ideal pinholes on
/// aligned rows, two Kannala-Brandt cameras) written out inline. Other rigs are passed on.
class RigModel {
 public:
  /// `rig` must outlive the model.
  explicit RigModel(const StereoRig& rig);

  /// Contract of StereoRig::residual.
  int residual(const Vector3d& p_left, const PixelObservation& z, StereoRig::Residual* r,
               StereoRig::Jacobian* jacobian = nullptr) const;

  /// Ideal pinholes on aligned rows.
  bool is_plain_rectified() const { return kind_ == Kind::kPlainRectified; }

 private:
  enum class Kind { kPlainRectified, kFisheye, kOther };

  int rectified_residual(const Vector3d& p, const PixelObservation& z, StereoRig::Residual* r,
                         StereoRig::Jacobian* jacobian) const;
  int fisheye_residual(const Vector3d& p, const PixelObservation& z, StereoRig::Residual* r,
                       StereoRig::Jacobian* jacobian) const;
  static bool project_fisheye(const Camera& c, const Vector3d& p, Eigen::Vector2d* pixel,
                              Eigen::Matrix<double, 2, 3>* jacobian);

  const StereoRig& rig_;
  Kind kind_ = Kind::kOther;
  Matrix3d R_right_left_;
};

inline RigModel::RigModel(const StereoRig& rig)
    : rig_(rig), R_right_left_(rig.T_right_left.rotation.toRotationMatrix()) {
  if (rig.kind == StereoRig::Kind::kRectified) {
    if (rig.left.is_ideal_pinhole()) kind_ = Kind::kPlainRectified;
  } else if (rig.left.model == CameraModel::kKannalaBrandt &&
             rig.right.model == CameraModel::kKannalaBrandt) {
    kind_ = Kind::kFisheye;
  }
}

inline int RigModel::residual(const Vector3d& p, const PixelObservation& z, StereoRig::Residual* r,
                              StereoRig::Jacobian* jacobian) const {
  if (kind_ == Kind::kPlainRectified) return rectified_residual(p, z, r, jacobian);
  if (kind_ == Kind::kFisheye) return fisheye_residual(p, z, r, jacobian);
  return rig_.residual(p, z, r, jacobian);
}

inline int RigModel::rectified_residual(const Vector3d& p, const PixelObservation& z,
                                        StereoRig::Residual* r,
                                        StereoRig::Jacobian* jacobian) const {
  if (!(p.z() > 1e-9)) return 0;
  const Camera& c = rig_.left;
  const double iz = 1.0 / p.z();
  const double x = p.x() * iz, y = p.y() * iz;
  const double u = c.fx * x + c.cx;
  (*r)(0) = u - z.left.x();
  (*r)(1) = c.fy * y + c.cy - z.left.y();
  const bool right = z.has_right();
  const double disparity = c.fx * rig_.baseline_m * iz;
  if (right) (*r)(2) = u - disparity - z.right.x();
  if (jacobian) {
    const double a = c.fx * iz, b = c.fy * iz;
    jacobian->row(0) << a, 0, -a * x;
    jacobian->row(1) << 0, b, -b * y;
    if (right) jacobian->row(2) << a, 0, disparity * iz - a * x;
  }
  return right ? 3 : 2;
}

inline int RigModel::fisheye_residual(const Vector3d& p, const PixelObservation& z,
                                      StereoRig::Residual* r, StereoRig::Jacobian* jacobian) const {
  Eigen::Vector2d pixel;
  Eigen::Matrix<double, 2, 3> j;
  if (!project_fisheye(rig_.left, p, &pixel, jacobian ? &j : nullptr)) return 0;
  r->head<2>() = pixel - z.left;
  if (jacobian) jacobian->topRows<2>() = j;
  if (!z.has_right()) return 2;
  const Vector3d p_right = R_right_left_ * p + rig_.T_right_left.translation;
  if (!project_fisheye(rig_.right, p_right, &pixel, jacobian ? &j : nullptr)) return 0;
  r->tail<2>() = pixel - z.right;
  if (jacobian) jacobian->bottomRows<2>().noalias() = j * R_right_left_;
  return 4;
}

/// Camera::is_projectable and Camera::project in one, so that the angle is computed once.
inline bool RigModel::project_fisheye(const Camera& c, const Vector3d& p, Eigen::Vector2d* pixel,
                                      Eigen::Matrix<double, 2, 3>* jacobian) {
  const double r2 = p.x() * p.x() + p.y() * p.y();
  const double r = std::sqrt(r2);
  if (!(r > 1e-12)) {  // on the axis, or not a number
    if (!c.is_projectable(p)) return false;
    *pixel = c.project(p, jacobian);
    return true;
  }
  const double n2 = r2 + p.z() * p.z();
  const double theta = std::atan2(r, p.z());
  const double t2 = theta * theta;
  const auto& k = c.distortion;
  const double theta_d = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
  const double slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])));
  if (!(n2 > 1e-18 && theta < 0.98 * M_PI && slope > 0)) return false;
  const double ux = p.x() / r, uy = p.y() / r;
  *pixel << c.fx * theta_d * ux + c.cx, c.fy * theta_d * uy + c.cy;
  if (jacobian) {
    const double s = theta_d / r;
    const double radial = slope * p.z() / n2;  // d theta_d / d r
    const double along = -slope * r / n2;      // d theta_d / d z
    const double cross = (radial - s) * ux * uy;
    *jacobian << c.fx * (s + (radial - s) * ux * ux), c.fx * cross, c.fx * along * ux, c.fy * cross,
        c.fy * (s + (radial - s) * uy * uy), c.fy * along * uy;
  }
  return true;
}

}  // namespace fastloop::optimization
