#include "fastloop/features/rectification.hpp"

#include <cmath>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>

#include "fastloop/core/error.hpp"
#include "fastloop/features/cv_view.hpp"

namespace fastloop {
namespace {

cv::Matx33d intrinsics(const Camera& c) {
  return {c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1};
}

cv::Matx<double, 1, 5> distortion(const Camera& c) {
  const auto& d = c.distortion;
  return {d[0], d[1], d[2], d[3], d[4]};
}

cv::Matx33d to_cv(const Matrix3d& m) {
  cv::Matx33d r;
  for (int i = 0; i < 9; ++i) r(i / 3, i % 3) = m(i / 3, i % 3);
  return r;
}

Matrix3d to_eigen(const cv::Matx33d& m) {
  Matrix3d r;
  for (int i = 0; i < 9; ++i) r(i / 3, i % 3) = m(i / 3, i % 3);
  return r;
}

/// True when rows agree to a hundredth of a pixel without any rectification.
bool is_rectified(const Camera& left, const Camera& right, const SE3& T_right_left) {
  if (!left.is_ideal_pinhole() || !right.is_ideal_pinhole()) return false;
  constexpr double kTolerancePx = 0.01;
  for (const double d : {left.fx - right.fx, left.fy - right.fy, left.cx - right.cx,
                         left.cy - right.cy, left.fx - left.fy})
    if (std::abs(d) > kTolerancePx) return false;
  const Vector3d& t = T_right_left.translation;
  return angle_between(T_right_left, SE3()) * left.width < kTolerancePx &&
         std::hypot(t.y(), t.z()) < 1e-4 * t.norm();
}

}  // namespace

struct Rectification::Maps {
  cv::Mat coordinates, fractions;  ///< fixed-point form of cv::remap

  Maps(const Camera& camera, const cv::Matx33d& rotation, const cv::Matx33d& new_camera) {
    cv::initUndistortRectifyMap(intrinsics(camera), distortion(camera), rotation, new_camera,
                                cv::Size(camera.width, camera.height), CV_16SC2, coordinates,
                                fractions);
  }
};

Rectification::Rectification() = default;
Rectification::~Rectification() = default;
Rectification::Rectification(Rectification&&) noexcept = default;
Rectification& Rectification::operator=(Rectification&&) noexcept = default;

Rectification Rectification::of_pair(const CameraCalibration& left,
                                     const CameraCalibration& right) {
  const SE3 T_right_left = right.T_body_camera.inverse() * left.T_body_camera;
  if (!T_right_left.is_finite() || T_right_left.translation.norm() < 1e-6)
    throw InvalidArgument("stereo calibration: the two cameras must be finitely far apart");
  Rectification result;
  StereoRig& rig = result.rig_;
  rig.kind = StereoRig::Kind::kRectified;
  rig.left = left.camera;
  rig.left.distortion = {};
  rig.T_body_left = left.T_body_camera;
  if (is_rectified(left.camera, right.camera, T_right_left)) {
    rig.baseline_m = -T_right_left.translation.x();
  } else {
    const cv::Size size(left.camera.width, left.camera.height);
    const Vector3d& t = T_right_left.translation;
    cv::Matx33d r_left, r_right;
    cv::Matx34d p_left, p_right;
    cv::Matx44d q;
    cv::stereoRectify(intrinsics(left.camera), distortion(left.camera), intrinsics(right.camera),
                      distortion(right.camera), size,
                      to_cv(T_right_left.rotation.toRotationMatrix()),
                      cv::Vec3d(t.x(), t.y(), t.z()), r_left, r_right, p_left, p_right, q,
                      cv::CALIB_ZERO_DISPARITY, 0, size);
    const auto new_camera = p_left.get_minor<3, 3>(0, 0);
    rig.left.fx = new_camera(0, 0);
    rig.left.fy = new_camera(1, 1);
    rig.left.cx = new_camera(0, 2);
    rig.left.cy = new_camera(1, 2);
    rig.baseline_m = -p_right(0, 3) / p_right(0, 0);
    rig.T_body_left =
        left.T_body_camera * SE3(Matrix3d(to_eigen(r_left).transpose()), Vector3d::Zero());
    result.maps_[0] = std::make_unique<Maps>(left.camera, r_left, new_camera);
    result.maps_[1] = std::make_unique<Maps>(right.camera, r_right, new_camera);
  }
  if (!(rig.baseline_m > 0))
    throw InvalidArgument(
        "stereo calibration: the second camera must be to the right of the first");
  if (const auto problem = rig.left.problem())
    throw InvalidArgument("stereo calibration cannot be rectified: " + *problem);
  rig.right = rig.left;
  rig.T_right_left = SE3(Eigen::Quaterniond::Identity(), Vector3d(-rig.baseline_m, 0, 0));
  return result;
}

Rectification Rectification::of_camera(const CameraCalibration& camera) {
  Rectification result;
  StereoRig& rig = result.rig_;
  rig.kind = StereoRig::Kind::kRectified;
  rig.left = camera.camera;
  rig.left.distortion = {};
  rig.right = rig.left;
  rig.T_body_left = camera.T_body_camera;
  if (!camera.camera.is_ideal_pinhole())
    result.maps_[0] =
        std::make_unique<Maps>(camera.camera, cv::Matx33d::eye(), intrinsics(rig.left));
  return result;
}

void Rectification::apply(int camera, const ImageU8& image, ImageU8& rectified) const {
  const Maps& maps = *maps_[camera];
  resize_storage(rectified, image.width, image.height);
  cv::Mat target = as_mat(rectified);
  cv::remap(as_mat(image), target, maps.coordinates, maps.fractions, cv::INTER_LINEAR,
            cv::BORDER_CONSTANT, cv::Scalar(0));
}

}  // namespace fastloop
