#pragma once

#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/yaml_node.hpp"

/// Shared by the readers of foreign calibrations.
namespace fastloop::io {

/// Values of Camera from "[fx, fy, cx, cy]", "[width, height]" and a list of distortion
/// coefficients.
void set_intrinsics(Camera& camera, const YamlNode& list);
void set_resolution(Camera& camera, const YamlNode& list);
/// Understands the names that EuRoC, Kalibr and ROS give the two models, and "none".
void set_distortion(Camera& camera, const YamlNode& model, const YamlNode* coefficients);

/// Reads noise values under the names that EuRoC and Kalibr share (gyroscope_noise_density, ...).
ImuCalibration read_imu_noise(const YamlNode& node, const char* rate_key);

/// Turns a failed Calibration::validate into an InputError of this file.
void check_calibration(const Calibration& calibration, const std::string& file);

}  // namespace fastloop::io
