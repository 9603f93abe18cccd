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
  ImageU8 right;                  ///< stereo; empty for RGB-D
  ImageF32 depth;                 ///< RGB-D; empty for stereo; metres
  std::vector<ImuSample> imu;     ///< since the previous frame, up to and including the first sample at or
                                  ///< after stamp_ns; stamps in camera time; empty without IMU
};

}  // namespace fastloop
