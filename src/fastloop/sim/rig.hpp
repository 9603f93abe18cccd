#pragma once

#include <string>

#include "fastloop/sensor/calibration.hpp"

namespace fastloop::sim {

enum class CameraKind { kPinhole, kFisheye, kRgbd };

/// @throws InvalidArgument on an unknown name; names are "pinhole", "fisheye", "rgbd"
CameraKind parse_camera_kind(const std::string& name);
std::string to_string(CameraKind kind);

/// The sensors of a simulated device.
///
/// kPinhole: 752x480 stereo with radial-tangential distortion and IMU, the published values of EuRoC.
/// kFisheye: 512x512 Kannala-Brandt stereo and IMU, the published values of TUM-VI.
/// kRgbd:    640x480 ideal pinhole with registered depth, no IMU; body = camera.
/// The IMU is that of EuRoC in either case.
Calibration make_rig(CameraKind kind);

/// Rotation from the body to the carrier (x forward, y left, z up), cam0 looking forward.
Eigen::Quaterniond carrier_from_body(const Calibration& calibration);

}  // namespace fastloop::sim
