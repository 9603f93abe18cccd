#include "fastloop/sensor/calibration.hpp"

#include <cmath>

#include "fastloop/core/error.hpp"

namespace fastloop {
namespace {

constexpr double kMinBaselineM = 1e-3;
constexpr double kMaxTimeShiftS = 10;

void require(bool ok, const std::string& name, const std::string& rule) {
  if (!ok) throw InvalidArgument("calibration: " + name + " " + rule);
}

void require_positive(double value, const std::string& name) {
  require(std::isfinite(value) && value > 0, name, "must be a positive number");
}

void validate_camera(const CameraCalibration& c, const std::string& name) {
  if (const auto problem = c.camera.problem())
    throw InvalidArgument("calibration: " + name + ": " + *problem);
  require(c.T_body_camera.is_finite(), name + ".T_body_camera", "must be finite");
  require(std::abs(c.T_body_camera.rotation.norm() - 1) < 1e-6, name + ".T_body_camera",
          "must hold a unit quaternion");
  require_positive(c.rate_hz, name + ".rate_hz");
}

void validate_imu(const ImuCalibration& imu) {
  require_positive(imu.rate_hz, "imu.rate_hz");
  require_positive(imu.gyro_noise_density, "imu.gyro_noise_density");
  require_positive(imu.gyro_random_walk, "imu.gyro_random_walk");
  require_positive(imu.accel_noise_density, "imu.accel_noise_density");
  require_positive(imu.accel_random_walk, "imu.accel_random_walk");
  require(std::abs(imu.time_shift_s) < kMaxTimeShiftS, "imu.time_shift_s",
          "must be a number of seconds between -10 and 10");
}

}  // namespace

void Calibration::validate() const {
  require(cameras.size() == 1 || cameras.size() == 2, "cameras",
          "must hold two cameras (stereo) or one (RGB-D), not " + std::to_string(cameras.size()));
  for (std::size_t i = 0; i < cameras.size(); ++i)
    validate_camera(cameras[i], "cam" + std::to_string(i));
  if (cameras.size() == 1) {
    require(depth.has_value(), "depth", "must be given for a single camera");
  } else {
    require(!depth.has_value(), "depth", "cannot be given for a stereo pair");
    const SE3 T_left_right = cameras[0].T_body_camera.inverse() * cameras[1].T_body_camera;
    require(T_left_right.translation.norm() >= kMinBaselineM, "cam1.T_body_camera",
            "must lie at least 1 mm away from cam0");
  }
  if (imu) validate_imu(*imu);
  if (depth) {
    require_positive(depth->units_per_metre, "depth.units_per_metre");
    require_positive(depth->virtual_baseline_m, "depth.virtual_baseline_m");
    require_positive(depth->max_depth_m, "depth.max_depth_m");
  }
}

}  // namespace fastloop
