#pragma once

#include <array>
#include <optional>
#include <string>

#include "fastloop/geometry/so3.hpp"

namespace fastloop {

enum class CameraModel : int {
  kPinhole,        ///< pinhole with radial-tangential distortion k1 k2 p1 p2 [k3]; all zero = ideal
  kKannalaBrandt,  ///< equidistant fisheye k1..k4 (Kannala and Brandt, PAMI 2006)
};

/// Projection of one camera. Camera frame: x right, y down, z forward; pixels: (0,0) is the centre
/// of the upper left pixel. A plain value: trivially copyable, usable in device code as raw
/// numbers.
struct Camera {
  CameraModel model = CameraModel::kPinhole;
  int width = 0, height = 0;              ///< pixels
  double fx = 0, fy = 0, cx = 0, cy = 0;  ///< pixels
  std::array<double, 5> distortion{};     ///< radtan: k1 k2 p1 p2 k3; Kannala-Brandt: k1 k2 k3 k4 -

  /// True for a pinhole without distortion (a rectified camera).
  bool is_ideal_pinhole() const;

  /// Pixel of a point in the camera frame. Pinhole points need z > 0; a fisheye also sees z <= 0.
  /// The result may lie outside the image (see `contains`). `jacobian`, if given: d pixel / d
  /// p_camera.
  Eigen::Vector2d project(const Vector3d& p_camera,
                          Eigen::Matrix<double, 2, 3>* jacobian = nullptr) const;

  /// True when `project` is meaningful: in front of a pinhole, or within the fisheye's field of
  /// view.
  bool is_projectable(const Vector3d& p_camera) const;

  /// Unit ray of a pixel in the camera frame (iterative undistortion, to 1e-10).
  Vector3d unproject(const Eigen::Vector2d& pixel) const;

  /// True when the pixel lies in the image, at least `border_px` from its edge.
  bool contains(const Eigen::Vector2d& pixel, double border_px = 0) const {
    return pixel.x() >= border_px && pixel.y() >= border_px && pixel.x() <= width - 1 - border_px &&
           pixel.y() <= height - 1 - border_px;
  }

  /// Reason why the values cannot be a camera (non-finite, focal length <= 0, empty image), if any.
  std::optional<std::string> problem() const;
};

}  // namespace fastloop
