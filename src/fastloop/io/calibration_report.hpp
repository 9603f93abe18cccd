#pragma once

#include <string>

#include "fastloop/sensor/calibration.hpp"

namespace fastloop::io {

/// What a person can check a calibration by: fields of view, baseline, angle between the cameras,
/// distance to the IMU, time shift; and a line "unusual: ..." for each value that is rarely right.
std::string describe_calibration(const Calibration& calibration);

}  // namespace fastloop::io
