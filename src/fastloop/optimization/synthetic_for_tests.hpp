#pragma once

#include <random>
#include <vector>

#include "fastloop/optimization/pose_only.hpp"

/// Small worlds with known truth for the tests and benchmarks of this folder. Nothing else includes
/// it.
namespace fastloop::optimization::synthetic {

inline Vector3d normal_vector(std::mt19937& rng, double sigma) {
  std::normal_distribution<double> n(0, sigma);
  const double x = n(rng), y = n(rng), z = n(rng);
  return {x, y, z};
}

inline SE3 random_pose(std::mt19937& rng, double angle, double distance) {
  return SE3(so3::exp(normal_vector(rng, angle)), normal_vector(rng, distance));
}

inline StereoRig rectified_rig() {
  StereoRig rig;
  rig.left.width = 752;
  rig.left.height = 480;
  rig.left.fx = 450;
  rig.left.fy = 455;
  rig.left.cx = 370;
  rig.left.cy = 245;
  rig.right = rig.left;
  rig.baseline_m = 0.11;
  rig.T_right_left = SE3(Eigen::Quaterniond::Identity(), Vector3d(-0.11, 0, 0));
  rig.T_body_left = SE3(so3::exp({0.1, -0.2, 1.5}), Vector3d(-0.02, -0.06, 0.01));
  return rig;
}

inline StereoRig fisheye_rig() {
  StereoRig rig;
  rig.kind = StereoRig::Kind::kGeneral;
  rig.left.model = CameraModel::kKannalaBrandt;
  rig.left.width = rig.left.height = 512;
  rig.left.fx = rig.left.fy = 190.5;
  rig.left.cx = 254.9;
  rig.left.cy = 256.9;
  rig.left.distortion = {0.0034, 0.0007, -0.002, 0.0002, 0};
  rig.right = rig.left;
  rig.right.cx = 252.6;
  rig.T_right_left = SE3(so3::exp({0.01, -0.02, 0.005}), Vector3d(-0.101, 0.002, 0.001));
  rig.baseline_m = 0.101;
  rig.T_body_left = SE3(so3::exp({-1.2, 0.4, 0.3}), Vector3d(0.045, -0.07, -0.05));
  return rig;
}

/// Measurement of a point by the rig, with pixel noise; nullopt outside of the left image.
inline std::optional<PixelObservation> observe(const StereoRig& rig, const Vector3d& p_left,
                                               double sigma_px, bool stereo, std::mt19937& rng) {
  if (!rig.left.is_projectable(p_left) || !rig.left.contains(rig.left.project(p_left))) return {};
  PixelObservation z;
  const Vector3d n = normal_vector(rng, sigma_px), m = normal_vector(rng, sigma_px);
  z.left = rig.left.project(p_left) + n.head<2>();
  if (!stereo) return z;
  if (rig.kind == StereoRig::Kind::kRectified) {
    const double u = rig.left.project(p_left).x() - rig.left.fx * rig.baseline_m / p_left.z();
    z.right = Eigen::Vector2d(u + m.x(), z.left.y());
  } else {
    const Vector3d p_right = rig.T_right_left * p_left;
    if (rig.right.is_projectable(p_right)) z.right = rig.right.project(p_right) + m.head<2>();
  }
  return z;
}

/// Observations of landmarks spread over the image at 1 to 15 m; three of four with a right part.
/// Every fourth is of a coarser octave, with noise to match.
inline std::vector<PoseObservation> observations(const StereoRig& rig, const SE3& T_world_body,
                                                 int n, double sigma_px, std::mt19937& rng) {
  std::uniform_real_distribution<double> u(0, 1);
  std::vector<PoseObservation> result;
  while (static_cast<int>(result.size()) < n) {
    const double x = u(rng) * rig.left.width, y = u(rng) * rig.left.height;
    const Vector3d p_left = (1 + 14 * u(rng)) * rig.left.unproject({x, y});
    const double scale = result.size() % 4 == 1 ? 1.44 : 1.0;
    const auto z = observe(rig, p_left, sigma_px * scale, result.size() % 4 != 3, rng);
    if (!z) continue;
    const double sigma = sigma_px > 0 ? sigma_px * scale : 1.0;
    result.push_back({T_world_body * (rig.T_body_left * p_left), *z, 1 / (sigma * sigma)});
  }
  return result;
}

/// Moves the measurements of the first `fraction` of the observations far away.
inline void add_outliers(std::vector<PoseObservation>& observations, double fraction,
                         std::mt19937& rng) {
  std::uniform_real_distribution<double> u(15, 80);
  for (std::size_t i = 0; i < fraction * static_cast<double>(observations.size()); ++i) {
    const double x = u(rng), y = u(rng);
    observations[i].pixel.left += Eigen::Vector2d(rng() % 2 ? x : -x, rng() % 2 ? y : -y);
  }
}

}  // namespace fastloop::optimization::synthetic
