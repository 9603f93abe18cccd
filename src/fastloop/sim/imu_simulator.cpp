#include "fastloop/sim/imu_simulator.hpp"

#include <cmath>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/random.hpp"

namespace fastloop::sim {
namespace {

Vector3d normal3(Random& random) {
  const double x = random.normal(), y = random.normal(), z = random.normal();
  return {x, y, z};
}

}  // namespace

SimulatedImu simulate_imu(const Trajectory& trajectory, const ImuCalibration& calibration,
                          Nanoseconds zero_ns, Nanoseconds begin_ns, Nanoseconds end_ns,
                          const ImuSimulationOptions& options) {
  if (!(calibration.rate_hz > 0)) throw InvalidArgument("the IMU rate must be positive");
  if (end_ns < begin_ns) throw InvalidArgument("the IMU simulation must not end before it begins");
  const double dt = 1.0 / calibration.rate_hz;
  // Discrete standard deviations: a density is per sqrt(Hz), a random walk grows with sqrt(time).
  const double gyro_sigma = calibration.gyro_noise_density / std::sqrt(dt);
  const double accel_sigma = calibration.accel_noise_density / std::sqrt(dt);
  const double gyro_step = calibration.gyro_random_walk * std::sqrt(dt);
  const double accel_step = calibration.accel_random_walk * std::sqrt(dt);

  Random random(options.seed);
  SimulatedImu result;
  ImuBias bias = options.initial_bias;
  const auto count =
      static_cast<std::size_t>(std::ceil(to_seconds(end_ns - begin_ns) / dt - 1e-9)) + 1;
  for (std::size_t k = 0; k < count; ++k) {
    ImuSample sample;
    sample.stamp_ns = begin_ns + from_seconds(static_cast<double>(k) * dt);
    const double t = to_seconds(sample.stamp_ns - zero_ns);
    const Eigen::Quaterniond R_body_world = trajectory.pose(t).rotation.conjugate();
    sample.gyro = trajectory.angular_velocity(t) + bias.gyro;
    sample.accel = R_body_world * (trajectory.acceleration(t) - kGravityWorld) + bias.accel;
    result.biases.push_back(bias);
    if (options.noise) {
      sample.gyro += gyro_sigma * normal3(random);
      sample.accel += accel_sigma * normal3(random);
      bias.gyro += gyro_step * normal3(random);
      bias.accel += accel_step * normal3(random);
    }
    result.samples.push_back(sample);
  }
  return result;
}

ImuBias draw_initial_bias(std::uint64_t seed) {
  Random random(mix64(seed) ^ 0xB1A5);
  ImuBias bias;
  for (int i = 0; i < 3; ++i) {
    bias.gyro[i] = (random.integer(2) ? 1 : -1) * random.uniform(0.004, 0.03);
    bias.accel[i] = (random.integer(2) ? 1 : -1) * random.uniform(0.03, 0.12);
  }
  return bias;
}

}  // namespace fastloop::sim
