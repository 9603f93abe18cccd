#include "fastloop/io/calibration_import_detail.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

bool one_of(const std::string& name, std::initializer_list<const char*> names) {
  return std::any_of(names.begin(), names.end(), [&](const char* n) { return name == n; });
}

}  // namespace

void set_intrinsics(Camera& camera, const YamlNode& list) {
  const auto k = list.numbers(4, 4);
  if (k[0] <= 0 || k[1] <= 0)
    list.fail("has a focal length that is not positive", "fx, fy, cx, cy in pixels");
  camera.fx = k[0], camera.fy = k[1], camera.cx = k[2], camera.cy = k[3];
}

void set_resolution(Camera& camera, const YamlNode& list) {
  const auto items = list.items();
  if (items.size() != 2)
    list.fail("has " + std::to_string(items.size()) + " values", "[width, height] in pixels");
  camera.width = items[0].integer(), camera.height = items[1].integer();
  if (camera.width <= 0 || camera.height <= 0)
    list.fail("is not an image size", "two whole numbers > 0");
}

void set_distortion(Camera& camera, const YamlNode& model, const YamlNode* coefficients) {
  const std::string name = lower_case(model.text());
  if (one_of(name, {"none", "ideal"})) return;
  const bool fisheye =
      one_of(name, {"equidistant", "kannala-brandt", "kannala_brandt", "kb4", "fisheye"});
  if (!fisheye && !one_of(name, {"radial-tangential", "radtan", "plumb_bob", "pinhole-radtan"}))
    model.fail("'" + model.text() + "' is an unknown distortion model",
               "radial-tangential (radtan), equidistant (kannala-brandt) or none");
  if (!coefficients)
    model.fail("has no coefficients beside it", "a list of distortion coefficients");
  camera.model = fisheye ? CameraModel::kKannalaBrandt : CameraModel::kPinhole;
  const auto d = coefficients->numbers(4, fisheye ? 4 : 5);
  std::copy(d.begin(), d.end(), camera.distortion.begin());
}

ImuCalibration read_imu_noise(const YamlNode& node, const char* rate_key) {
  ImuCalibration imu;
  if (const auto rate = node.find(rate_key)) imu.rate_hz = rate->positive_number();
  const auto read = [&](const char* name, const char* unit) {
    return node.required(name, unit).positive_number();
  };
  imu.gyro_noise_density = read("gyroscope_noise_density", "rad / s / sqrt(Hz)");
  imu.gyro_random_walk = read("gyroscope_random_walk", "rad / s^2 / sqrt(Hz)");
  imu.accel_noise_density = read("accelerometer_noise_density", "m / s^2 / sqrt(Hz)");
  imu.accel_random_walk = read("accelerometer_random_walk", "m / s^3 / sqrt(Hz)");
  return imu;
}

void check_calibration(const Calibration& calibration, const std::string& file) {
  try {
    calibration.validate();
  } catch (const InvalidArgument& e) {
    throw InputError(in_file(file), e.what());
  }
}

}  // namespace fastloop::io
