#include "fastloop/sensor/imu.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"

namespace fastloop {
namespace {

using Matrix9d = Eigen::Matrix<double, 9, 9>;

/// Measurement at `stamp_ns` on the straight line through two samples.
ImuSample interpolate(const ImuSample& a, const ImuSample& b, Nanoseconds stamp_ns) {
  const double s =
      static_cast<double>(stamp_ns - a.stamp_ns) / static_cast<double>(b.stamp_ns - a.stamp_ns);
  return {stamp_ns, a.gyro + s * (b.gyro - a.gyro), a.accel + s * (b.accel - a.accel)};
}

/// Measurement at `stamp_ns`; outside of the samples the nearest one holds.
ImuSample sample_at(std::span<const ImuSample> samples, Nanoseconds stamp_ns) {
  const auto after =
      std::lower_bound(samples.begin(), samples.end(), stamp_ns,
                       [](const ImuSample& s, Nanoseconds stamp) { return s.stamp_ns < stamp; });
  ImuSample result;
  if (after == samples.end()) {
    result = samples.back();
  } else if (after->stamp_ns == stamp_ns || after == samples.begin()) {
    result = *after;
  } else {
    result = interpolate(*(after - 1), *after, stamp_ns);
  }
  result.stamp_ns = stamp_ns;
  return result;
}

void check_samples(std::span<const ImuSample> samples, Nanoseconds begin_ns, Nanoseconds end_ns,
                   const ImuBias& bias) {
  if (end_ns <= begin_ns) throw InvalidArgument("IMU interval must end after it begins");
  if (samples.empty()) throw InvalidArgument("IMU interval without samples");
  if (!bias.gyro.allFinite() || !bias.accel.allFinite())
    throw InvalidArgument("IMU bias is not finite");
  for (std::size_t i = 0; i < samples.size(); ++i) {
    if (!samples[i].gyro.allFinite() || !samples[i].accel.allFinite())
      throw InvalidArgument("IMU sample is not finite");
    if (i > 0 && samples[i].stamp_ns < samples[i - 1].stamp_ns)
      throw InvalidArgument("IMU samples are not in the order of time");
  }
}

}  // namespace

PreintegratedImu::PreintegratedImu(std::span<const ImuSample> samples, Nanoseconds begin_ns,
                                   Nanoseconds end_ns, const ImuBias& bias,
                                   const ImuCalibration& noise)
    : begin_ns_(begin_ns), end_ns_(end_ns), bias_(bias), noise_(noise) {
  check_samples(samples, begin_ns, end_ns, bias);
  samples_.reserve(samples.size() + 2);
  samples_.push_back(sample_at(samples, begin_ns));
  for (const ImuSample& s : samples) {
    // Strictly increasing: of samples with equal stamps the first is kept.
    if (s.stamp_ns > samples_.back().stamp_ns && s.stamp_ns < end_ns) samples_.push_back(s);
  }
  samples_.push_back(sample_at(samples, end_ns));
  integrate();
}

void PreintegratedImu::integrate() {
  delta_R_.setIdentity();
  delta_v_.setZero();
  delta_p_.setZero();
  for (Matrix3d* m : {&dR_dbg_, &dV_dbg_, &dV_dba_, &dP_dbg_, &dP_dba_}) m->setZero();
  covariance_.setZero();
  const double gyro_density2 = noise_.gyro_noise_density * noise_.gyro_noise_density;
  const double accel_density2 = noise_.accel_noise_density * noise_.accel_noise_density;

  for (std::size_t k = 0; k + 1 < samples_.size(); ++k) {
    const ImuSample &s0 = samples_[k], &s1 = samples_[k + 1];
    const double dt = to_seconds(s1.stamp_ns - s0.stamp_ns);
    const Vector3d omega = 0.5 * (s0.gyro + s1.gyro) - bias_.gyro;
    const Vector3d accel = 0.5 * (s0.accel + s1.accel) - bias_.accel;

    // Rotation at the middle of the step turns the mean acceleration: second order in dt.
    const Eigen::Quaterniond half_turn = so3::exp(0.5 * dt * omega);
    const Matrix3d half_turn_inv = half_turn.toRotationMatrix().transpose();
    const Matrix3d turn_inv = half_turn_inv * half_turn_inv;
    const Matrix3d R_mid = (delta_R_ * half_turn).toRotationMatrix();
    const Matrix3d jr_half = 0.5 * dt * so3::right_jacobian(0.5 * dt * omega);
    const Matrix3d jr = dt * so3::right_jacobian(dt * omega);
    const Matrix3d lever = -R_mid * so3::hat(accel);  // d (R_mid accel) / d rotation at the middle

    // Error propagation x' = A x + B_gyro n_gyro + B_accel n_accel, order [rotation, velocity,
    // position].
    Matrix9d a = Matrix9d::Identity();
    a.block<3, 3>(0, 0) = turn_inv;
    a.block<3, 3>(3, 0) = lever * half_turn_inv * dt;
    a.block<3, 3>(6, 0) = lever * half_turn_inv * (0.5 * dt * dt);
    a.block<3, 3>(6, 3) = dt * Matrix3d::Identity();
    Eigen::Matrix<double, 9, 3> b_gyro, b_accel;
    b_gyro << jr, lever * jr_half * dt, lever * jr_half * (0.5 * dt * dt);
    b_accel << Matrix3d::Zero(), R_mid * dt, R_mid * (0.5 * dt * dt);
    covariance_ = (a * covariance_ * a.transpose()).eval();
    covariance_ += (gyro_density2 / dt) * b_gyro * b_gyro.transpose();
    covariance_ += (accel_density2 / dt) * b_accel * b_accel.transpose();
    // White noise that acts all through the step leaves this much position variance beyond its
    // mean.
    covariance_.diagonal().tail<3>().array() += accel_density2 * dt * dt * dt / 12.0;

    // A bias acts like a measurement error of the opposite sign in every step.
    const Matrix3d dR_mid_dbg = half_turn_inv * dR_dbg_ - jr_half;
    dP_dbg_ += dV_dbg_ * dt + lever * dR_mid_dbg * (0.5 * dt * dt);
    dP_dba_ += dV_dba_ * dt - R_mid * (0.5 * dt * dt);
    dV_dbg_ += lever * dR_mid_dbg * dt;
    dV_dba_ -= R_mid * dt;
    dR_dbg_ = (turn_inv * dR_dbg_ - jr).eval();

    delta_p_ += delta_v_ * dt + R_mid * accel * (0.5 * dt * dt);
    delta_v_ += R_mid * accel * dt;
    delta_R_ = (delta_R_ * half_turn * half_turn).normalized();
  }
  covariance_ = (0.5 * (covariance_ + covariance_.transpose())).eval();
}

PreintegratedImu PreintegratedImu::joined(const PreintegratedImu& next) const {
  if (next.begin_ns_ != end_ns_) throw InvalidArgument("joined IMU intervals must be adjacent");
  PreintegratedImu result = *this;
  result.end_ns_ = next.end_ns_;
  // Both intervals hold a sample at the seam. They are equal when both were interpolated; where one
  // side had to be extrapolated, their mean is the better guess.
  ImuSample& seam = result.samples_.back();
  seam.gyro = 0.5 * (seam.gyro + next.samples_.front().gyro);
  seam.accel = 0.5 * (seam.accel + next.samples_.front().accel);
  result.samples_.insert(result.samples_.end(), next.samples_.begin() + 1, next.samples_.end());
  result.integrate();
  return result;
}

PreintegratedImu PreintegratedImu::rebased(const ImuBias& bias) const {
  if (!bias.gyro.allFinite() || !bias.accel.allFinite())
    throw InvalidArgument("IMU bias is not finite");
  PreintegratedImu result = *this;
  result.bias_ = bias;
  result.integrate();
  return result;
}

Eigen::Quaterniond PreintegratedImu::delta_rotation(const ImuBias& bias) const {
  return delta_R_ * so3::exp(dR_dbg_ * (bias.gyro - bias_.gyro));
}

Vector3d PreintegratedImu::delta_velocity(const ImuBias& bias) const {
  return delta_v_ + dV_dbg_ * (bias.gyro - bias_.gyro) + dV_dba_ * (bias.accel - bias_.accel);
}

Vector3d PreintegratedImu::delta_position(const ImuBias& bias) const {
  return delta_p_ + dP_dbg_ * (bias.gyro - bias_.gyro) + dP_dba_ * (bias.accel - bias_.accel);
}

NavState PreintegratedImu::predict(const NavState& from) const {
  const double dt = duration_s();
  const Eigen::Quaterniond& R = from.T_world_body.rotation;
  NavState to;
  to.T_world_body = SE3(R * delta_rotation(from.bias),
                        from.T_world_body.translation + from.v_world * dt +
                            0.5 * dt * dt * kGravityWorld + R * delta_position(from.bias));
  to.v_world = from.v_world + dt * kGravityWorld + R * delta_velocity(from.bias);
  to.bias = from.bias;
  return to;
}

double PreintegratedImu::gyro_bias_variance() const {
  return noise_.gyro_random_walk * noise_.gyro_random_walk * duration_s();
}

double PreintegratedImu::accel_bias_variance() const {
  return noise_.accel_random_walk * noise_.accel_random_walk * duration_s();
}

}  // namespace fastloop
