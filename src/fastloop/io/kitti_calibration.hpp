#pragma once

#include <string>

#include "fastloop/sensor/calibration.hpp"

namespace fastloop::io {

/// KITTI odometry calib.txt: lines "P0: 12 numbers", the projection K [I | t] of each rectified
/// camera. The body is the left camera; the file does not know the image size.
/// @throws InputError naming file, line and key
Calibration parse_kitti_calibration(const std::string& text, const std::string& file,
                                    int left_camera, int width, int height);

}  // namespace fastloop::io
