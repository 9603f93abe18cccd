#include "fastloop/matching/camera_view.hpp"

#include <algorithm>

#include "fastloop/geometry/camera.hpp"

namespace fastloop::matching {
namespace {

/// First angle at which the slope of theta_d stops being positive, at most 0.98 pi (as
/// Camera::is_projectable).
double monotonic_limit(const Camera& camera) {
  constexpr double kMaxTheta = 0.98 * M_PI, kStep = 0.02;
  const auto& k = camera.distortion;
  const auto rises = [&](double theta) {
    const double t2 = theta * theta;
    return 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3]))) > 0;
  };
  double rising = 0;
  while (rising < kMaxTheta && rises(rising + kStep)) rising += kStep;
  if (rising >= kMaxTheta) return kMaxTheta;
  double falling = rising + kStep;
  while (falling - rising > 1e-7) {
    const double middle = (rising + falling) / 2;
    (rises(middle) ? rising : falling) = middle;
  }
  return std::min(rising, kMaxTheta);
}

}  // namespace

CameraView make_camera_view(const Camera& camera) {
  CameraView view;
  view.fisheye = camera.model == CameraModel::kKannalaBrandt;
  view.distorted = !view.fisheye && !camera.is_ideal_pinhole();
  view.max_x = static_cast<float>(camera.width - 1);
  view.max_y = static_cast<float>(camera.height - 1);
  view.fx = static_cast<float>(camera.fx);
  view.fy = static_cast<float>(camera.fy);
  view.cx = static_cast<float>(camera.cx);
  view.cy = static_cast<float>(camera.cy);
  for (int i = 0; i < 5; ++i) view.k[i] = static_cast<float>(camera.distortion[i]);
  if (view.fisheye) view.max_theta = static_cast<float>(monotonic_limit(camera));
  return view;
}

}  // namespace fastloop::matching
