#pragma once

#include <cmath>
#include <limits>

#include "fastloop/geometry/camera.hpp"
#include "fastloop/geometry/se3.hpp"

namespace fastloop {

/// Where one landmark was seen in one frame. Pixels of the rig's cameras; `right` is NaN where
/// unseen.
struct PixelObservation {
  Eigen::Vector2d left = Eigen::Vector2d::Zero();
  Eigen::Vector2d right = Eigen::Vector2d::Constant(std::numeric_limits<double>::quiet_NaN());

  bool has_right() const { return !std::isnan(right.x()); }
};

/// The cameras of a frame as the optimisers see them. The left camera is the camera frame of a
/// keyframe.
///
/// kRectified: ideal pinhole, rows aligned (stereo after rectification, or RGB-D with a virtual
/// right
///             coordinate): residual [u_left, v, u_right], 3 numbers.
/// kGeneral:   any two cameras (fisheye): residual [u_left, v_left, u_right, v_right], 4 numbers.
/// An observation without a right part has 2 numbers in either case.
struct StereoRig {
  enum class Kind : int { kRectified, kGeneral };

  Kind kind = Kind::kRectified;
  Camera left;
  Camera right;      ///< kRectified: equal to left
  SE3 T_right_left;  ///< kRectified: translation (-baseline, 0, 0)
  SE3 T_body_left;   ///< body = IMU frame, or the left camera when there is no IMU
  double baseline_m = 0;

  static constexpr int kMaxResidual = 4;
  using Residual = Eigen::Matrix<double, kMaxResidual, 1>;
  using Jacobian = Eigen::Matrix<double, kMaxResidual, 3>;

  /// The point that a left pixel shows at a depth (z in the frame of the left camera).
  Vector3d point_at_depth(const Eigen::Vector2d& pixel, double depth_m) const {
    const Vector3d ray = left.unproject(pixel);
    return ray * (depth_m / ray.z());
  }

  int residual_size(const PixelObservation& z) const {
    return !z.has_right() ? 2 : kind == Kind::kRectified ? 3 : 4;
  }

  /// Residual projection - measurement, in pixels. Only the first `residual_size(z)` rows are
  /// written.
  /// @param jacobian  if given, d residual / d p_left
  /// @return number of rows, or 0 when the point cannot be projected
  int residual(const Vector3d& p_left, const PixelObservation& z, Residual* r,
               Jacobian* jacobian = nullptr) const;
};

/// 95 % quantile of chi-square with 2, 3 or 4 degrees of freedom: gate of a normalised squared
/// residual.
constexpr double chi2_gate(int residual_size) {
  return residual_size == 2 ? 5.991 : residual_size == 3 ? 7.815 : 9.488;
}

}  // namespace fastloop
