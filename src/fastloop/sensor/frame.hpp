#pragma once

#include <vector>

#include "fastloop/core/time.hpp"
#include "fastloop/sensor/image.hpp"
#include "fastloop/sensor/imu.hpp"

namespace fastloop {

/// What the sensors delivered for one frame: the input of the system.
struct FrameInput {
  Nanoseconds stamp_ns = 0;
  ImageU8 left;
  ImageU8 right;   ///< stereo; empty for RGB-D
  ImageF32 depth;  ///< RGB-D; empty for stereo; metres
  /// From the last sample at or before the previous frame's stamp, up to and including the first
  /// sample at or after stamp_ns, as far as recorded: neighbouring frames share samples, so that
  /// both ends can be interpolated. Strictly increasing stamps in camera time. The first frame of a
  /// data set gets the samples around its own stamp only. Empty without IMU.
  std::vector<ImuSample> imu;
};

}  // namespace fastloop
