#pragma once

#include <filesystem>
#include <string>

#include "fastloop/sensor/calibration.hpp"

/// fastloop's own calibration file; docs/calibration.md describes every key.
///
///   cameras:
///     - model: pinhole-radtan              # or kannala-brandt
///       resolution: [752, 480]             # width, height
///       intrinsics: [458, 457, 367, 248]   # fx, fy, cx, cy
///       distortion: [-0.28, 0.07, 0, 0]    # pinhole-radtan: k1 k2 p1 p2 [k3]; kannala-brandt: k1
///       k2 k3 k4
///   T_body_cam0: [16 numbers, row by row]
namespace fastloop::io {

/// Strict: an unknown, repeated, missing, non-finite or impossible value is an error.
/// @throws InputError naming file, line and key
Calibration load_calibration(const std::filesystem::path& path);

/// The same from text; `file` is only used in messages.
Calibration parse_calibration(const std::string& text, const std::string& file);

/// @throws InvalidArgument when the calibration is not valid, InputError when the file cannot be
/// written
void save_calibration(const std::filesystem::path& path, const Calibration& calibration);

/// Text of the file; parsing it gives the same numbers back.
std::string to_yaml(const Calibration& calibration);

}  // namespace fastloop::io
