#pragma once

#include <memory>
#include <string>
#include <vector>

#include "fastloop/sensor/imu.hpp"

namespace fastloop::optimization {

/// Inertial-only MAP estimation (Campos, Montiel, Tardos, ICRA 2020): keyframe poses up to gravity
/// direction (and scale) are known from vision; sought are gravity direction, scale, biases,
/// velocities.
struct InertialInitProblem {
  std::vector<SE3> T_world_body;  ///< [n] n >= 3, visual world, body centres metric or up to scale
  std::vector<std::shared_ptr<const PreintegratedImu>> between;  ///< [n - 1]
  std::vector<Vector3d> v_world;  ///< [n] start values; empty: from finite differences of positions
  ImuBias bias;                   ///< start value, one bias for all keyframes
  Matrix3d R_world_gravity =
      Matrix3d::Identity();  ///< start value; identity-like start: computed from velocity
                             ///< differences if `guess_gravity`
  bool guess_gravity = true;
  bool estimate_scale = false;           ///< stereo and RGB-D: false
  double gyro_prior_information = 1e2;   ///< of the bias about zero: standard deviation 0.1 rad / s
  double accel_prior_information = 1e2;  ///< standard deviation 0.1 m / s^2
  double position_stddev_m =
      2e-3;  ///< of one keyframe pose from vision; widens the IMU's covariance
  double rotation_stddev_rad = 5e-4;
};

struct InertialInitResult {
  bool success = false;
  std::string reason;  ///< why not: "too little motion", "did not converge", ...
  Matrix3d R_world_gravity =
      Matrix3d::Identity();  ///< gravity in the visual world = R * kGravityWorld
  double scale = 1;
  ImuBias bias;
  std::vector<Vector3d> v_world;  ///< [n] in the visual world, metric
  double gravity_stddev_rad =
      0;  ///< from the Hessian: standard deviation of the direction of gravity
  double accel_bias_stddev = 0;  ///< m / s^2, largest axis
};

/// Levenberg-Marquardt over all unknowns at once; the measurements are integrated again about the
/// bias found and solved once more. Standard deviations are widened where the residuals exceed the
/// model.
/// @throws InvalidArgument on unequal extents or missing measurements
InertialInitResult initialize_inertial(const InertialInitProblem& problem);

}  // namespace fastloop::optimization
