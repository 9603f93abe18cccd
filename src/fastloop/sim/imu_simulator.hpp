#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/sensor/imu.hpp"
#include "fastloop/sim/trajectory.hpp"

namespace fastloop::sim {

struct ImuSimulationOptions {
  std::uint64_t seed = 1;
  bool noise = true;    ///< white noise and bias random walk
  ImuBias initial_bias; ///< at the first sample
};

struct SimulatedImu {
  std::vector<ImuSample> samples;
  std::vector<ImuBias> biases;  ///< [samples] true bias of each sample
};

/// What an ideal IMU with this calibration's rate and noise measures along the motion.
/// Sample k is taken at begin_ns + k / rate, the last one at or after end_ns; trajectory time 0 is zero_ns.
SimulatedImu simulate_imu(const Trajectory& trajectory, const ImuCalibration& calibration,
                          Nanoseconds zero_ns, Nanoseconds begin_ns, Nanoseconds end_ns,
                          const ImuSimulationOptions& options);

/// A moderate constant bias drawn from the seed: about 0.02 rad/s and 0.1 m/s^2.
ImuBias draw_initial_bias(std::uint64_t seed);

}  // namespace fastloop::sim
