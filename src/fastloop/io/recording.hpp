#pragma once

#include <memory>

#include "fastloop/io/dataset.hpp"

namespace fastloop::io {

/// Files of one frame.
struct RecordedFrame {
  Nanoseconds stamp_ns = 0;
  std::filesystem::path left;
  std::filesystem::path second;  ///< right image, or depth image
};

/// A sequence as a reader found it: what every layout comes down to.
struct Recording {
  std::string format;
  Calibration calibration;
  bool camera_rate_known = true;  ///< otherwise it is measured from the stamps
  std::vector<RecordedFrame> frames;
  std::vector<ImuSample> imu;
  std::optional<std::filesystem::path> ground_truth;
  std::vector<std::string> remarks;
};

/// Checks the recording (calibration fits the images, stamps increase) and makes a Dataset of it.
/// @throws InputError
std::unique_ptr<Dataset> make_dataset(Recording recording, const std::filesystem::path& folder);

}  // namespace fastloop::io
