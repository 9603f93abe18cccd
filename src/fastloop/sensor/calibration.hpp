#pragma once

#include <optional>
#include <string>
#include <vector>

#include "fastloop/geometry/camera.hpp"
#include "fastloop/geometry/se3.hpp"

namespace fastloop {

struct CameraCalibration {
  Camera camera;
  SE3 T_body_camera;  ///< body = IMU frame; identity for cam0 when there is no IMU
  double rate_hz = 20;
};

/// Continuous-time noise of the IMU, one value for all three axes.
struct ImuCalibration {
  double rate_hz = 200;
  double gyro_noise_density = 1.7e-4;  ///< rad / s / sqrt(Hz)
  double gyro_random_walk = 2e-5;      ///< rad / s^2 / sqrt(Hz)
  double accel_noise_density = 2e-3;   ///< m / s^2 / sqrt(Hz)
  double accel_random_walk = 3e-3;     ///< m / s^3 / sqrt(Hz)
  /// t_imu = t_camera + time_shift_s (Kalibr's timeshift_cam_imu), seconds.
  double time_shift_s = 0;
};

/// Depth image registered to cam0.
struct DepthCalibration {
  double units_per_metre = 1000;  ///< stored value of one metre
  /// Of the virtual right coordinate u_right = u - fx * b / depth: with the pixel noise of a
  /// keypoint it sets how much depth is trusted. 0.3 m makes one pixel about 2 cm at 2 m, a
  /// structured-light camera's noise with some reserve.
  double virtual_baseline_m = 0.3;
  double max_depth_m = 10;
};

/// What is known of the sensors of a data set.
struct Calibration {
  std::vector<CameraCalibration>
      cameras;  ///< [1] RGB-D or [2] stereo; cam0 is the reference camera
  std::optional<ImuCalibration> imu;
  std::optional<DepthCalibration> depth;

  /// Throws InvalidArgument naming the first value that cannot be right.
  void validate() const;
};

}  // namespace fastloop
