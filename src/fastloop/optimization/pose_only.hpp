#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "fastloop/sensor/imu.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop::optimization {

/// One landmark seen in the frame whose pose is sought.
struct PoseObservation {
  Vector3d p_world = Vector3d::Zero();
  PixelObservation pixel;
  double inv_sigma2 = 1;  ///< 1 / variance of the pixel coordinates (octave)
};

struct PoseOnlyResult {
  SE3 T_world_body;
  std::vector<std::uint8_t> inlier;  ///< [observations]
  int num_inliers = 0;
};

/// Pose of one frame from known landmarks: Levenberg-Marquardt with Huber kernel, four rounds of
/// ten iterations; after each round every observation is classified by chi2_gate (at the current
/// pose, also those left out so far), the last round without kernel. Landmarks are fixed.
/// Deterministic, reentrant. Fewer than 3 usable observations: returns the initial pose, no
/// inliers.
PoseOnlyResult optimize_pose(const StereoRig& rig, const SE3& initial_T_world_body,
                             std::span<const PoseObservation> observations);

/// Gaussian prior on a NavState: 15 numbers in the order rotation, position, velocity, gyro bias,
/// accel bias; error = [mean.T_world_body.local(x), v - v_mean, bg - bg_mean, ba - ba_mean].
struct NavPrior {
  NavState mean;
  Eigen::Matrix<double, 15, 15> information = Eigen::Matrix<double, 15, 15>::Zero();
};

struct InertialPoseProblem {
  const StereoRig* rig = nullptr;
  std::span<const PoseObservation> observations;  ///< of the current frame
  NavState previous;                              ///< state at imu->begin_ns()
  const PreintegratedImu* imu = nullptr;          ///< previous -> current
  std::optional<NavPrior> prior;  ///< on `previous`; without it `previous` is held fixed
  NavState initial;               ///< of the current frame
};

struct InertialPoseResult {
  NavState state;                    ///< current frame
  std::vector<std::uint8_t> inlier;  ///< [observations]
  int num_inliers = 0;
  NavPrior prior;  ///< marginal of the current frame (previous marginalised out): for the next call
};

/// Visual-inertial pose of the current frame: reprojection + preintegration + bias random walk (+
/// marginal prior of the previous frame; Campos et al., T-RO 2021). Same rounds and gates as
/// optimize_pose.
InertialPoseResult optimize_pose_inertial(const InertialPoseProblem& problem);

}  // namespace fastloop::optimization
