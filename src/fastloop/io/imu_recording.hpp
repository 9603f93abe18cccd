#pragma once

#include <filesystem>
#include <span>
#include <string>
#include <vector>

#include "fastloop/sensor/imu.hpp"

namespace fastloop::io {

/// IMU samples of a sequence, in camera time, with strictly increasing stamps.
struct ImuRecording {
  std::vector<ImuSample> samples;
  std::vector<std::string>
      remarks;  ///< what was repaired or dropped, and where samples are missing
};

/// Reads an EuRoC imu0/data.csv; repairs order and duplicates and drops rows that are not finite.
/// @param time_shift_s  t_imu = t_camera + time_shift_s; removed from the stamps
/// @throws InputError naming file and line
ImuRecording read_imu_recording(const std::filesystem::path& csv, double time_shift_s);

/// The same from text; `file` is only used in messages.
ImuRecording parse_imu_recording(std::string_view text, const std::string& file,
                                 double time_shift_s);

/// The samples needed to integrate from `begin_ns` to `end_ns`: from the last one at or before the
/// begin up to and including the first one at or after the end, as far as they exist.
std::span<const ImuSample> imu_covering(std::span<const ImuSample> samples, Nanoseconds begin_ns,
                                        Nanoseconds end_ns);

}  // namespace fastloop::io
