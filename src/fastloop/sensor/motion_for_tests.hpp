#pragma once

#include <cmath>
#include <random>
#include <vector>

#include "fastloop/sensor/imu.hpp"

/// A smooth motion with known derivatives and its IMU, for tests and benchmarks. Nothing else
/// includes it.
namespace fastloop::synthetic {

/// Attitude R(t) = Rz(yaw) Ry(pitch) Rx(roll) and position by sines, in a world with z up.
struct Motion {
  static Matrix3d rotation(double t) {
    using Eigen::AngleAxisd;
    return (AngleAxisd(0.7 * std::sin(0.9 * t), Vector3d::UnitZ()) *
            AngleAxisd(0.4 * std::sin(1.3 * t + 0.3), Vector3d::UnitY()) *
            AngleAxisd(0.3 * std::sin(1.7 * t + 0.8), Vector3d::UnitX()))
        .toRotationMatrix();
  }
  static Vector3d position(double t) {
    return {std::sin(0.8 * t), 1.5 * std::cos(0.5 * t), 0.4 * std::sin(1.1 * t)};
  }
  static Vector3d velocity(double t) {
    return {0.8 * std::cos(0.8 * t), -0.75 * std::sin(0.5 * t), 0.44 * std::cos(1.1 * t)};
  }
  static Vector3d acceleration(double t) {
    return {-0.64 * std::sin(0.8 * t), -0.375 * std::cos(0.5 * t), -0.484 * std::sin(1.1 * t)};
  }
  static ImuSample sample(Nanoseconds stamp_ns) {
    const double t = to_seconds(stamp_ns), h = 1e-5;
    const Eigen::Quaterniond step(Matrix3d(rotation(t - h).transpose() * rotation(t + h)));
    return {stamp_ns, so3::log(step) / (2 * h),
            rotation(t).transpose() * (acceleration(t) - kGravityWorld)};
  }
  static NavState state(Nanoseconds stamp_ns) {
    const double t = to_seconds(stamp_ns);
    return {SE3(rotation(t), position(t)), velocity(t), {}};
  }
};

inline std::vector<ImuSample> regular_samples(Nanoseconds begin_ns, Nanoseconds end_ns,
                                              Nanoseconds step_ns) {
  std::vector<ImuSample> samples;
  for (Nanoseconds t = begin_ns; t <= end_ns; t += step_ns) samples.push_back(Motion::sample(t));
  return samples;
}

/// Adds a constant bias and white noise of the given densities.
inline void disturb(std::vector<ImuSample>& samples, const ImuBias& bias,
                    const ImuCalibration& noise, std::mt19937& rng) {
  std::normal_distribution<double> n(0, 1);
  const double root_rate = std::sqrt(noise.rate_hz);
  for (ImuSample& s : samples)
    for (int k = 0; k < 3; ++k) {
      s.gyro(k) += bias.gyro(k) + noise.gyro_noise_density * root_rate * n(rng);
      s.accel(k) += bias.accel(k) + noise.accel_noise_density * root_rate * n(rng);
    }
}

}  // namespace fastloop::synthetic
