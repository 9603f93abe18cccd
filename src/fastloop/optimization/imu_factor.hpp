#pragma once

#include "fastloop/sensor/imu.hpp"

namespace fastloop::optimization {

/// Error between two states joined by preintegrated measurements (Forster et al., T-RO 2017) and
/// the random walk of the bias; shared by the inertial optimisers.
///
/// Residual (15): [rotation, velocity, position, gyro bias, accel bias], whitened.
/// State perturbation (15): [rotation, position] by SE3::retract, [velocity, gyro bias, accel bias]
/// by addition. The increments follow the bias of the first state to first order.
class ImuFactor {
 public:
  using Vector15d = Eigen::Matrix<double, 15, 1>;
  using Matrix15d = Eigen::Matrix<double, 15, 15>;

  /// `imu` must outlive the factor.
  explicit ImuFactor(const PreintegratedImu& imu);

  /// @param d_from, d_to  if given, derivatives by the perturbations of the states
  Vector15d residual(const NavState& from, const NavState& to, Matrix15d* d_from = nullptr,
                     Matrix15d* d_to = nullptr) const;

 private:
  /// What the states say about the interval, in the body frame of the first.
  struct Changes {
    Matrix3d R_from_inv;
    Eigen::Quaterniond turn;
    Vector3d rotation_error, velocity, position;
  };
  Matrix15d derivative_by_from(const NavState& from, const Changes& c) const;
  Matrix15d derivative_by_to(const Changes& c) const;

  const PreintegratedImu* imu_;
  Eigen::Matrix<double, 9, 9> sqrt_information_;  ///< W^T W = inverse covariance
  double gyro_walk_weight_, accel_walk_weight_;
};

/// Root W with W^T W = covariance^-1. Tolerates a covariance that is singular to rounding.
Eigen::Matrix<double, 9, 9> sqrt_information_of(const Eigen::Matrix<double, 9, 9>& covariance);

/// `state` moved by a perturbation in the order [rotation, position, velocity, gyro bias, accel
/// bias].
NavState retract(const NavState& state, const Eigen::Matrix<double, 15, 1>& d);
/// Inverse of retract.
Eigen::Matrix<double, 15, 1> local(const NavState& from, const NavState& to);

}  // namespace fastloop::optimization
