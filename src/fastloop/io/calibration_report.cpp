#include "fastloop/io/calibration_report.hpp"

#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <vector>

namespace fastloop::io {
namespace {

constexpr double kDegrees = 180.0 / M_PI;

__attribute__((format(printf, 1, 2))) std::string formatted(const char* format, ...) {
  char buffer[256];
  va_list arguments;
  va_start(arguments, format);
  std::vsnprintf(buffer, sizeof buffer, format, arguments);
  va_end(arguments);
  return buffer;
}

/// Angle between the rays of two opposite edge pixels, measured through the optical axis.
double field_of_view_deg(const Camera& c, bool horizontal) {
  const auto from_axis = [&](double x, double y) {
    const Vector3d ray = c.unproject({x, y});
    return std::atan2(ray.head<2>().norm(), ray.z());
  };
  return kDegrees * (horizontal ? from_axis(0, c.cy) + from_axis(c.width - 1, c.cy)
                                : from_axis(c.cx, 0) + from_axis(c.cx, c.height - 1));
}

void describe_camera(const CameraCalibration& camera, int index, std::string& text,
                     std::vector<std::string>& unusual) {
  const Camera& c = camera.camera;
  const double h = field_of_view_deg(c, true), v = field_of_view_deg(c, false);
  text += formatted("cam%d          %s, %dx%d, %.4g Hz, field of view %.1f x %.1f deg\n", index,
                    c.model == CameraModel::kPinhole ? "pinhole-radtan" : "kannala-brandt", c.width,
                    c.height, camera.rate_hz, h, v);
  if (h < 20 || h > 220) unusual.push_back(formatted("cam%d sees %.0f deg", index, h));
  if (std::abs(c.cx / c.width - 0.5) > 0.15 || std::abs(c.cy / c.height - 0.5) > 0.15)
    unusual.push_back(
        formatted("cam%d: principal point (%.1f, %.1f) is far from the middle of the image", index,
                  c.cx, c.cy));
  if (std::abs(c.fx / c.fy - 1) > 0.1)
    unusual.push_back(
        formatted("cam%d: fx %.1f and fy %.1f differ by more than 10 %%", index, c.fx, c.fy));
}

void describe_pair(const Calibration& calibration, std::string& text,
                   std::vector<std::string>& unusual) {
  const SE3& T_body_left = calibration.cameras[0].T_body_camera;
  const SE3& T_body_right = calibration.cameras[1].T_body_camera;
  const Vector3d p = (T_body_left.inverse() * T_body_right).translation;
  const double angle = kDegrees * angle_between(T_body_left, T_body_right);
  text += formatted("baseline      %.4f m; cam1 at (%.4f, %.4f, %.4f) m in cam0\n", p.norm(), p.x(),
                    p.y(), p.z());
  text += formatted("cameras       rotated by %.3f deg against each other\n", angle);
  if (p.norm() < 0.02 || p.norm() > 2) unusual.push_back(formatted("baseline of %.4f m", p.norm()));
  if (p.x() < 0.8 * p.norm())
    unusual.push_back(
        "cam1 is not to the right of cam0: are the cameras or the direction of a transformation "
        "swapped?");
  if (angle > 20) unusual.push_back(formatted("%.1f deg between the cameras", angle));
}

void describe_imu(const Calibration& calibration, std::string& text,
                  std::vector<std::string>& unusual) {
  const ImuCalibration& imu = *calibration.imu;
  const double distance = calibration.cameras[0].T_body_camera.translation.norm();
  text +=
      formatted("IMU           %.4g Hz; cam0 is %.4f m away and turned by %.2f deg\n", imu.rate_hz,
                distance, kDegrees * angle_between(SE3(), calibration.cameras[0].T_body_camera));
  text += formatted(
      "IMU noise     gyro %.3g rad/s/sqrt(Hz), walk %.3g; accel %.3g m/s^2/sqrt(Hz), walk %.3g\n",
      imu.gyro_noise_density, imu.gyro_random_walk, imu.accel_noise_density, imu.accel_random_walk);
  text += formatted("time shift    %+.6f s (t_imu = t_camera + shift)\n", imu.time_shift_s);
  if (distance > 1) unusual.push_back(formatted("IMU %.2f m away from cam0", distance));
  if (std::abs(imu.time_shift_s) > 0.1)
    unusual.push_back(formatted("time shift of %.3f s", imu.time_shift_s));
  if (imu.gyro_noise_density < 1e-6 || imu.gyro_noise_density > 0.1)
    unusual.push_back(formatted("gyro noise density of %.3g", imu.gyro_noise_density));
  if (imu.accel_noise_density < 1e-5 || imu.accel_noise_density > 1)
    unusual.push_back(formatted("accelerometer noise density of %.3g", imu.accel_noise_density));
}

}  // namespace

std::string describe_calibration(const Calibration& calibration) {
  calibration.validate();
  std::string text;
  std::vector<std::string> unusual;
  int index = 0;
  for (const CameraCalibration& camera : calibration.cameras)
    describe_camera(camera, index++, text, unusual);
  if (calibration.cameras.size() == 2) describe_pair(calibration, text, unusual);
  if (calibration.imu) {
    describe_imu(calibration, text, unusual);
  } else {
    text += "IMU           none\n";
  }
  if (calibration.depth)
    text += formatted(
        "depth         %.6g units per metre, used up to %.3g m, virtual baseline %.4f m\n",
        calibration.depth->units_per_metre, calibration.depth->max_depth_m,
        calibration.depth->virtual_baseline_m);
  for (const std::string& line : unusual) text += "unusual       " + line + "\n";
  return text;
}

}  // namespace fastloop::io
