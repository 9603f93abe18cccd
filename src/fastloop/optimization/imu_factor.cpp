#include "fastloop/optimization/imu_factor.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

namespace fastloop::optimization {
namespace {

using Matrix9d = Eigen::Matrix<double, 9, 9>;

/// A random walk of zero would make the weight infinite; this is far below that of any sensor.
constexpr double kMinBiasVariance = 1e-16;

}  // namespace

Matrix9d sqrt_information_of(const Matrix9d& covariance) {
  // Rotation, velocity and position variances differ by many orders of magnitude: factorise the
  // correlations and scale afterwards.
  const Eigen::Matrix<double, 9, 1> stddev = covariance.diagonal().cwiseMax(1e-24).cwiseSqrt();
  const Eigen::Matrix<double, 9, 1> inverse_stddev = stddev.cwiseInverse();
  Matrix9d correlation = inverse_stddev.asDiagonal() * covariance * inverse_stddev.asDiagonal();
  correlation.diagonal().setOnes();
  Eigen::LLT<Matrix9d> llt(correlation);
  for (double jitter = 1e-12; llt.info() != Eigen::Success && jitter < 1; jitter *= 10)
    llt.compute(correlation + jitter * Matrix9d::Identity());
  // covariance^-1 = S L^-T L^-1 S, so L^-1 S is a root.
  return llt.matrixL().solve(Matrix9d(inverse_stddev.asDiagonal()));
}

ImuFactor::ImuFactor(const PreintegratedImu& imu)
    : imu_(&imu),
      sqrt_information_(sqrt_information_of(imu.covariance())),
      gyro_walk_weight_(1.0 / std::sqrt(std::max(imu.gyro_bias_variance(), kMinBiasVariance))),
      accel_walk_weight_(1.0 / std::sqrt(std::max(imu.accel_bias_variance(), kMinBiasVariance))) {}

ImuFactor::Vector15d ImuFactor::residual(const NavState& from, const NavState& to,
                                         Matrix15d* d_from, Matrix15d* d_to) const {
  const double dt = imu_->duration_s();
  Changes c;
  c.R_from_inv = from.T_world_body.rotation.toRotationMatrix().transpose();
  c.turn = from.T_world_body.rotation.conjugate() * to.T_world_body.rotation;
  c.rotation_error = so3::log(imu_->delta_rotation(from.bias).conjugate() * c.turn);
  c.velocity = c.R_from_inv * (to.v_world - from.v_world - dt * kGravityWorld);
  c.position = c.R_from_inv * (to.T_world_body.translation - from.T_world_body.translation -
                               dt * from.v_world - 0.5 * dt * dt * kGravityWorld);
  Vector15d r;
  r << c.rotation_error, c.velocity - imu_->delta_velocity(from.bias),
      c.position - imu_->delta_position(from.bias), to.bias.gyro - from.bias.gyro,
      to.bias.accel - from.bias.accel;
  const auto whiten = [&](auto& m) {
    m.template topRows<9>() = (sqrt_information_ * m.template topRows<9>()).eval();
    m.template middleRows<3>(9) *= gyro_walk_weight_;
    m.template bottomRows<3>() *= accel_walk_weight_;
  };
  if (d_from) {
    *d_from = derivative_by_from(from, c);
    whiten(*d_from);
  }
  if (d_to) {
    *d_to = derivative_by_to(c);
    whiten(*d_to);
  }
  whiten(r);
  return r;
}

ImuFactor::Matrix15d ImuFactor::derivative_by_from(const NavState& from, const Changes& c) const {
  const Matrix3d jr_inv = so3::right_jacobian_inverse(c.rotation_error);
  const Matrix3d& d_turn = imu_->d_rotation_d_gyro_bias();
  const Vector3d correction = d_turn * (from.bias.gyro - imu_->bias().gyro);
  Matrix15d j = Matrix15d::Zero();
  j.block<3, 3>(0, 0) = -jr_inv * c.turn.toRotationMatrix().transpose();
  j.block<3, 3>(0, 9) = -jr_inv * so3::exp(c.rotation_error).toRotationMatrix().transpose() *
                        so3::right_jacobian(correction) * d_turn;
  j.block<3, 3>(3, 0) = so3::hat(c.velocity);
  j.block<3, 3>(3, 6) = -c.R_from_inv;
  j.block<3, 3>(3, 9) = -imu_->d_velocity_d_gyro_bias();
  j.block<3, 3>(3, 12) = -imu_->d_velocity_d_accel_bias();
  j.block<3, 3>(6, 0) = so3::hat(c.position);
  j.block<3, 3>(6, 3) = -Matrix3d::Identity();
  j.block<3, 3>(6, 6) = -imu_->duration_s() * c.R_from_inv;
  j.block<3, 3>(6, 9) = -imu_->d_position_d_gyro_bias();
  j.block<3, 3>(6, 12) = -imu_->d_position_d_accel_bias();
  j.block<6, 6>(9, 9) = -Matrix6d::Identity();
  return j;
}

ImuFactor::Matrix15d ImuFactor::derivative_by_to(const Changes& c) const {
  Matrix15d j = Matrix15d::Zero();
  j.block<3, 3>(0, 0) = so3::right_jacobian_inverse(c.rotation_error);
  j.block<3, 3>(3, 6) = c.R_from_inv;
  j.block<3, 3>(6, 3) = c.turn.toRotationMatrix();
  j.block<6, 6>(9, 9).setIdentity();
  return j;
}

NavState retract(const NavState& state, const Eigen::Matrix<double, 15, 1>& d) {
  NavState moved;
  moved.T_world_body = state.T_world_body.retract(d.head<6>());
  moved.v_world = state.v_world + d.segment<3>(6);
  moved.bias.gyro = state.bias.gyro + d.segment<3>(9);
  moved.bias.accel = state.bias.accel + d.segment<3>(12);
  return moved;
}

Eigen::Matrix<double, 15, 1> local(const NavState& from, const NavState& to) {
  Eigen::Matrix<double, 15, 1> d;
  d << from.T_world_body.local(to.T_world_body), to.v_world - from.v_world,
      to.bias.gyro - from.bias.gyro, to.bias.accel - from.bias.accel;
  return d;
}

}  // namespace fastloop::optimization
