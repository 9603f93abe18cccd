#include "fastloop/sensor/imu.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "fastloop/core/error.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop {
namespace {

using synthetic::Motion;
using synthetic::regular_samples;

const ImuBias kSomeBias{{0.01, -0.02, 0.015}, {0.05, 0.1, -0.08}};
constexpr Nanoseconds kSecond = 1'000'000'000;

void expect_state_near(const NavState& a, const NavState& b, double angle, double velocity,
                       double position) {
  EXPECT_LT(angle_between(a.T_world_body, b.T_world_body), angle);
  EXPECT_LT((a.v_world - b.v_world).norm(), velocity);
  EXPECT_LT((a.T_world_body.translation - b.T_world_body.translation).norm(), position);
}

TEST(PreintegratedImu, PredictsAnAnalyticMotion) {
  const auto samples = regular_samples(0, 2 * kSecond, 5'000'000);
  const PreintegratedImu imu(samples, 0, 2 * kSecond, {}, {});
  expect_state_near(imu.predict(Motion::state(0)), Motion::state(2 * kSecond), 1e-4, 2e-4, 2e-4);
}

TEST(PreintegratedImu, ErrorFallsWithTheSquareOfTheStep) {
  double errors[2];
  for (int i = 0; i < 2; ++i) {
    const auto samples = regular_samples(0, kSecond, i == 0 ? 20'000'000 : 10'000'000);
    const PreintegratedImu imu(samples, 0, kSecond, {}, {});
    errors[i] = (imu.predict(Motion::state(0)).T_world_body.translation -
                 Motion::state(kSecond).T_world_body.translation)
                    .norm();
  }
  EXPECT_NEAR(errors[0] / errors[1], 4.0, 0.5);
}

TEST(PreintegratedImu, CoversExactlyTheIntervalBetweenSamples) {
  const auto samples = regular_samples(0, kSecond, 5'000'000);
  const Nanoseconds begin = 101'300'000, end = 853'900'000;
  const PreintegratedImu imu(samples, begin, end, {}, {});
  EXPECT_EQ(imu.samples().front().stamp_ns, begin);
  EXPECT_EQ(imu.samples().back().stamp_ns, end);
  EXPECT_DOUBLE_EQ(imu.duration_s(), 0.7526);
  expect_state_near(imu.predict(Motion::state(begin)), Motion::state(end), 1e-4, 1e-4, 1e-4);
}

TEST(PreintegratedImu, ToleratesUnevenSamplesGapsAndDuplicates) {
  auto samples = regular_samples(0, kSecond, 4'000'000);
  std::mt19937 rng(4);
  std::erase_if(samples, [&](const ImuSample& s) {
    const bool gap = s.stamp_ns > 400'000'000 && s.stamp_ns < 450'000'000;
    return gap || rng() % 4 == 0;
  });
  samples.insert(samples.begin() + 20, samples[20]);
  const PreintegratedImu imu(samples, 50'000'000, 950'000'000, {}, {});
  expect_state_near(imu.predict(Motion::state(50'000'000)), Motion::state(950'000'000), 5e-4, 3e-3,
                    2e-3);
  EXPECT_TRUE(imu.covariance().allFinite());
}

TEST(PreintegratedImu, ExtrapolatesTheNearestSample) {
  const ImuSample still{500, Vector3d(0, 0, 1), -kGravityWorld};
  const PreintegratedImu imu({&still, 1}, 0, kSecond, {}, {});
  EXPECT_NEAR(so3::log(imu.delta_rotation({})).z(), 1.0, 1e-12);
  EXPECT_NEAR(imu.delta_velocity({}).z(), 9.81, 1e-9);
  EXPECT_NEAR(imu.delta_position({}).z(), 0.5 * 9.81, 1e-9);
}

TEST(PreintegratedImu, BiasJacobiansMatchReintegration) {
  const auto samples = regular_samples(0, kSecond, 5'000'000);
  const PreintegratedImu imu(samples, 3'000'000, 600'000'000, kSomeBias, {});
  const double h = 1e-6;
  for (int k = 0; k < 6; ++k) {
    ImuBias plus = kSomeBias, minus = kSomeBias;
    (k < 3 ? plus.gyro : plus.accel)(k % 3) += h;
    (k < 3 ? minus.gyro : minus.accel)(k % 3) -= h;
    const PreintegratedImu a = imu.rebased(plus), b = imu.rebased(minus);
    const Vector3d dv = (a.delta_velocity(plus) - b.delta_velocity(minus)) / (2 * h);
    const Vector3d dp = (a.delta_position(plus) - b.delta_position(minus)) / (2 * h);
    const Eigen::Quaterniond R = imu.delta_rotation(kSomeBias);
    const Vector3d dR = (so3::log(R.conjugate() * a.delta_rotation(plus)) -
                         so3::log(R.conjugate() * b.delta_rotation(minus))) /
                        (2 * h);
    const int c = k % 3;
    EXPECT_LT((dR - (k < 3 ? imu.d_rotation_d_gyro_bias().col(c).eval() : Vector3d::Zero().eval()))
                  .norm(),
              1e-7);
    EXPECT_LT(
        (dv - (k < 3 ? imu.d_velocity_d_gyro_bias() : imu.d_velocity_d_accel_bias()).col(c)).norm(),
        1e-7);
    EXPECT_LT(
        (dp - (k < 3 ? imu.d_position_d_gyro_bias() : imu.d_position_d_accel_bias()).col(c)).norm(),
        1e-7);
  }
}

TEST(PreintegratedImu, FirstOrderCorrectionIsCloseToReintegration) {
  const auto samples = regular_samples(0, kSecond, 5'000'000);
  const PreintegratedImu imu(samples, 0, 500'000'000, {}, {});
  const ImuBias bias{{1e-3, -2e-3, 1e-3}, {0.02, -0.01, 0.03}};
  const PreintegratedImu exact = imu.rebased(bias);
  EXPECT_LT(imu.delta_rotation(bias).angularDistance(exact.delta_rotation(bias)), 2e-6);
  EXPECT_LT((imu.delta_velocity(bias) - exact.delta_velocity(bias)).norm(), 2e-5);
  EXPECT_LT((imu.delta_position(bias) - exact.delta_position(bias)).norm(), 1e-5);
}

TEST(PreintegratedImu, JoinedEqualsOneIntegration) {
  const auto samples = regular_samples(0, kSecond, 5'000'000);
  const Nanoseconds seam = 400'000'000;  // on a sample: the joined interval has the same steps
  const PreintegratedImu whole(samples, 0, kSecond, kSomeBias, {});
  const PreintegratedImu joined = PreintegratedImu(samples, 0, seam, kSomeBias, {})
                                      .joined(PreintegratedImu(samples, seam, kSecond, {}, {}));
  EXPECT_EQ(joined.samples().size(), whole.samples().size());
  EXPECT_EQ(joined.end_ns(), kSecond);
  EXPECT_TRUE(joined.delta_velocity(kSomeBias) == whole.delta_velocity(kSomeBias));
  EXPECT_TRUE(joined.delta_position(kSomeBias) == whole.delta_position(kSomeBias));
  EXPECT_TRUE(joined.covariance() == whole.covariance());

  const PreintegratedImu between =
      PreintegratedImu(samples, 0, 402'000'000, {}, {})
          .joined(PreintegratedImu(samples, 402'000'000, kSecond, {}, {}));
  for (std::size_t i = 1; i < between.samples().size(); ++i)
    EXPECT_GT(between.samples()[i].stamp_ns, between.samples()[i - 1].stamp_ns);
  expect_state_near(between.predict(Motion::state(0)), Motion::state(kSecond), 1e-4, 1e-4, 1e-4);
  EXPECT_THROW(joined.joined(whole), InvalidArgument);
}

/// Error of increments integrated from noisy samples, in the error state of the covariance.
Eigen::Matrix<double, 9, 1> increment_error(const PreintegratedImu& truth,
                                            const PreintegratedImu& noisy) {
  Eigen::Matrix<double, 9, 1> e;
  e << so3::log(truth.delta_rotation({}).conjugate() * noisy.delta_rotation({})),
      noisy.delta_velocity({}) - truth.delta_velocity({}),
      noisy.delta_position({}) - truth.delta_position({});
  return e;
}

TEST(PreintegratedImu, CovarianceMatchesMonteCarlo) {
  ImuCalibration noise;
  noise.gyro_noise_density = 1e-3;
  noise.accel_noise_density = 1e-2;
  const auto samples = regular_samples(0, kSecond, 5'000'000);
  const PreintegratedImu truth(samples, 0, kSecond, {}, noise);
  std::mt19937 rng(5);
  std::normal_distribution<double> n(0, 1);
  const double per_sample = std::sqrt(200.0);
  const int trials = 2000;
  Eigen::Matrix<double, 9, 9> sum = Eigen::Matrix<double, 9, 9>::Zero();
  double nees = 0;
  for (int i = 0; i < trials; ++i) {
    auto noisy = samples;
    for (ImuSample& s : noisy) {
      s.gyro += 1e-3 * per_sample * Vector3d(n(rng), n(rng), n(rng));
      s.accel += 1e-2 * per_sample * Vector3d(n(rng), n(rng), n(rng));
    }
    const auto e = increment_error(truth, PreintegratedImu(noisy, 0, kSecond, {}, noise));
    sum += e * e.transpose();
    nees += e.dot(truth.covariance().llt().solve(e));
  }
  sum /= trials;
  // The mean NEES of 9 numbers is 9 with standard deviation sqrt(18 / trials) = 0.1.
  EXPECT_NEAR(nees / trials, 9.0, 0.5);
  const Eigen::Matrix<double, 9, 1> sd = truth.covariance().diagonal().cwiseSqrt();
  for (int r = 0; r < 9; ++r)
    for (int c = 0; c < 9; ++c)
      EXPECT_NEAR(sum(r, c) / (sd(r) * sd(c)), truth.covariance()(r, c) / (sd(r) * sd(c)), 0.12);
}

TEST(PreintegratedImu, CovarianceIsPositiveDefiniteForASingleStep) {
  const auto samples = regular_samples(0, 10'000'000, 5'000'000);
  const PreintegratedImu imu(samples, 0, 5'000'000, {}, {});
  const Eigen::Matrix<double, 9, 1> scale = imu.covariance().diagonal().cwiseSqrt().cwiseInverse();
  const Eigen::Matrix<double, 9, 9> correlation =
      scale.asDiagonal() * imu.covariance() * scale.asDiagonal();
  EXPECT_EQ(correlation.llt().info(), Eigen::Success);
}

TEST(PreintegratedImu, BiasVarianceGrowsWithTime) {
  ImuCalibration noise;
  const auto samples = regular_samples(0, kSecond, 5'000'000);
  const PreintegratedImu imu(samples, 0, kSecond / 2, {}, noise);
  EXPECT_DOUBLE_EQ(imu.gyro_bias_variance(), 0.5 * noise.gyro_random_walk * noise.gyro_random_walk);
  EXPECT_DOUBLE_EQ(imu.accel_bias_variance(),
                   0.5 * noise.accel_random_walk * noise.accel_random_walk);
}

TEST(PreintegratedImu, RejectsWhatItCannotIntegrate) {
  auto samples = regular_samples(0, kSecond, 5'000'000);
  EXPECT_THROW(PreintegratedImu(samples, 10, 10, {}, {}), InvalidArgument);
  EXPECT_THROW(PreintegratedImu({}, 0, 10, {}, {}), InvalidArgument);
  std::swap(samples[3], samples[4]);
  EXPECT_THROW(PreintegratedImu(samples, 0, kSecond, {}, {}), InvalidArgument);
  std::swap(samples[3], samples[4]);
  const PreintegratedImu good(samples, 0, kSecond, {}, {});
  samples[7].accel.y() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(PreintegratedImu(samples, 0, kSecond, {}, {}), InvalidArgument);
  ImuBias bad;
  bad.gyro.x() = std::numeric_limits<double>::infinity();
  EXPECT_THROW(good.rebased(bad), InvalidArgument);
}

}  // namespace
}  // namespace fastloop
