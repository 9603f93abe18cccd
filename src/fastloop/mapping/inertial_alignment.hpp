#pragma once

#include <atomic>
#include <string>

#include "fastloop/map/map.hpp"
#include "fastloop/mapping/options.hpp"

namespace fastloop::mapping {

/// What happened to the IMU state of a map in one step; for the event log.
struct ImuStep {
  enum class Kind { kNone, kInitialised, kRefined, kFailed } kind = Kind::kNone;
  std::string reason;
  double seconds = 0;  ///< of keyframes used
  double gravity_stddev_rad = 0;
};

/// Initialises the IMU of a map from its keyframes (inertial-only MAP estimation), turns the map so
/// that z is up, then adjusts it visual-inertially; repeats with more data at the refinement times.
/// Waits (kNone) while there are too few keyframes or too little time.
ImuStep align_to_imu(map::Map& map, MapId id, const MappingOptions& options,
                     const std::atomic<bool>* cancel);

}  // namespace fastloop::mapping
