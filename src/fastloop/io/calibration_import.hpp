#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/sensor/calibration.hpp"

/// Calibrations written by other programs; docs/calibration.md says what is read from each.
namespace fastloop::io {

enum class CalibrationKind { kFastloop, kKalibr, kOrbSlam, kEuroc };

std::string name_of(CalibrationKind kind);

struct ImportedCalibration {
  Calibration calibration;
  CalibrationKind kind = CalibrationKind::kFastloop;
  bool camera_rate_known = true;
  std::vector<std::string> remarks;  ///< what had to be assumed
};

/// Recognises the kind of a calibration file and reads it. A folder with EuRoC cam0/sensor.yaml ...
/// works too, and so does such a sensor.yaml itself.
/// @param imu_file  IMU noise of a Kalibr calibration; without it, a file beside the camchain is
/// looked for
/// @throws InputError naming file, line and key
ImportedCalibration import_calibration(const std::filesystem::path& path,
                                       const std::optional<std::filesystem::path>& imu_file = {});

/// A file's text and the name it has in messages.
struct NamedText {
  std::string text, file;
};

/// What kind of calibration a file is, by its keys. @throws InputError when it is none.
CalibrationKind recognise_calibration(const NamedText& yaml);

/// Kalibr "camchain" (of the cameras alone, or with the IMU) and its IMU noise file.
ImportedCalibration parse_kalibr(const NamedText& camchain, const std::optional<NamedText>& imu);
/// ORB-SLAM3 settings (version 1.0, and the older flat form for rectified or RGB-D cameras).
ImportedCalibration parse_orb_slam(const NamedText& settings);
/// EuRoC sensor.yaml of each camera, and of the IMU where there is one.
ImportedCalibration parse_euroc_sensors(const std::vector<NamedText>& cameras,
                                        const std::optional<NamedText>& imu);
/// The same from a folder that holds cam0, cam1 and, where there is one, imu0.
ImportedCalibration read_euroc_sensors(const std::filesystem::path& folder);

}  // namespace fastloop::io
