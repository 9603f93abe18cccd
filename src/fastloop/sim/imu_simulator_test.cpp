#include "fastloop/sim/imu_simulator.hpp"

#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/motion.hpp"
#include "fastloop/sim/rig.hpp"

namespace fastloop::sim {
namespace {

const ImuCalibration kImu = *make_rig(CameraKind::kPinhole).imu;

Trajectory room_motion() {
  return make_motion(WorldKind::kRoom, 12, 3, carrier_from_body(make_rig(CameraKind::kPinhole)));
}

TEST(ImuSimulator, IntegratingNoiseFreeSamplesGivesTheMotionBack) {
  const Trajectory x = room_motion();
  ImuSimulationOptions options;
  options.noise = false;
  const SimulatedImu imu = simulate_imu(x, kImu, 0, 0, from_seconds(10), options);
  ASSERT_EQ(imu.samples.size(), 2001u);

  // Independent integration: mean of neighbouring samples, forces turned into the world at mid-interval.
  SE3 T = x.pose(0);
  Vector3d v = x.velocity(0);
  for (std::size_t k = 0; k + 1 < imu.samples.size(); ++k) {
    const double dt = to_seconds(imu.samples[k + 1].stamp_ns - imu.samples[k].stamp_ns);
    const Vector3d gyro = 0.5 * (imu.samples[k].gyro + imu.samples[k + 1].gyro);
    const Eigen::Quaterniond next = T.rotation * so3::exp(gyro * dt);
    const Vector3d a0 = T.rotation * imu.samples[k].accel + kGravityWorld;
    const Vector3d a1 = next * imu.samples[k + 1].accel + kGravityWorld;
    T.translation += v * dt + (2 * a0 + a1) * dt * dt / 6;
    v += 0.5 * (a0 + a1) * dt;
    T.rotation = next;
  }
  EXPECT_LT((T.translation - x.pose(10).translation).norm(), 1e-3);
  EXPECT_LT(angle_between(T, x.pose(10)), 1e-4);
  EXPECT_LT((v - x.velocity(10)).norm(), 1e-3);
}

TEST(ImuSimulator, AtRestItMeasuresGravityUpwards) {
  const Trajectory rest(0, 0.1, std::vector<SE3>(60));
  ImuSimulationOptions options;
  options.noise = false;
  for (const ImuSample& s : simulate_imu(rest, kImu, 0, 0, from_seconds(5), options).samples) {
    EXPECT_LT((s.accel - Vector3d(0, 0, 9.81)).norm(), 1e-9);
    EXPECT_LT(s.gyro.norm(), 1e-9);
  }
}

TEST(ImuSimulator, NoiseHasTheDensitiesOfTheCalibration) {
  const Trajectory rest(0, 0.1, std::vector<SE3>(60));
  ImuSimulationOptions options;
  options.seed = 7;
  const SimulatedImu imu = simulate_imu(rest, kImu, 0, 0, from_seconds(400), options);
  const std::size_t n = imu.samples.size();
  double gyro2 = 0, accel2 = 0, gyro_step2 = 0, accel_step2 = 0;
  for (std::size_t k = 0; k < n; ++k) {
    gyro2 += (imu.samples[k].gyro - imu.biases[k].gyro).squaredNorm();
    accel2 += (imu.samples[k].accel - imu.biases[k].accel - Vector3d(0, 0, 9.81)).squaredNorm();
    if (k == 0) continue;
    gyro_step2 += (imu.biases[k].gyro - imu.biases[k - 1].gyro).squaredNorm();
    accel_step2 += (imu.biases[k].accel - imu.biases[k - 1].accel).squaredNorm();
  }
  // 240,000 numbers each: the standard deviation is known to 0.15 %; 1 % is beyond 6 sigma.
  const double samples = 3.0 * static_cast<double>(n), steps = 3.0 * static_cast<double>(n - 1);
  const double root_rate = std::sqrt(kImu.rate_hz);
  EXPECT_NEAR(std::sqrt(gyro2 / samples) / (kImu.gyro_noise_density * root_rate), 1, 0.01);
  EXPECT_NEAR(std::sqrt(accel2 / samples) / (kImu.accel_noise_density * root_rate), 1, 0.01);
  EXPECT_NEAR(std::sqrt(gyro_step2 / steps) * root_rate / kImu.gyro_random_walk, 1, 0.01);
  EXPECT_NEAR(std::sqrt(accel_step2 / steps) * root_rate / kImu.accel_random_walk, 1, 0.01);
}

TEST(ImuSimulator, CoversTheIntervalAndRepeatsWithTheSeed) {
  const Trajectory x = room_motion();
  ImuSimulationOptions options;
  options.initial_bias = draw_initial_bias(4);
  const SimulatedImu a = simulate_imu(x, kImu, 100, 100, 100 + from_seconds(1.0033), options);
  const SimulatedImu b = simulate_imu(x, kImu, 100, 100, 100 + from_seconds(1.0033), options);
  EXPECT_EQ(a.samples.front().stamp_ns, 100);
  EXPECT_GE(a.samples.back().stamp_ns, 100 + from_seconds(1.0033));
  EXPECT_LT(a.samples.back().stamp_ns, 100 + from_seconds(1.0083));
  ASSERT_EQ(a.samples.size(), b.samples.size());
  for (std::size_t k = 0; k < a.samples.size(); ++k) EXPECT_EQ(a.samples[k].gyro, b.samples[k].gyro);
  options.seed = 2;
  EXPECT_NE(simulate_imu(x, kImu, 100, 100, 200, options).samples[0].gyro, a.samples[0].gyro);
  EXPECT_GT(options.initial_bias.gyro.norm(), 0.005);
  EXPECT_LT(options.initial_bias.accel.norm(), 0.25);
}

TEST(ImuSimulator, RefusesBadIntervals) {
  EXPECT_THROW(simulate_imu(room_motion(), kImu, 0, 10, 5, {}), InvalidArgument);
  ImuCalibration no_rate = kImu;
  no_rate.rate_hz = 0;
  EXPECT_THROW(simulate_imu(room_motion(), no_rate, 0, 0, 5, {}), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::sim
