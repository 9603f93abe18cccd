#pragma once

#include <span>
#include <vector>

#include "fastloop/core/time.hpp"
#include "fastloop/geometry/se3.hpp"
#include "fastloop/sensor/calibration.hpp"

namespace fastloop {

/// Gravity in the gravity-aligned world (z up), m / s^2.
inline const Vector3d kGravityWorld{0, 0, -9.81};

struct ImuSample {
  Nanoseconds stamp_ns = 0;
  Vector3d gyro = Vector3d::Zero();   ///< rad / s, body frame
  Vector3d accel = Vector3d::Zero();  ///< specific force, m / s^2, body frame
};

struct ImuBias {
  Vector3d gyro = Vector3d::Zero();
  Vector3d accel = Vector3d::Zero();
};

/// Pose, velocity and bias of the body at one time.
struct NavState {
  SE3 T_world_body;
  Vector3d v_world = Vector3d::Zero();
  ImuBias bias;
};

/// IMU measurements between two times, preintegrated on the manifold
/// (Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", T-RO
/// 2017).
///
/// Error state order everywhere: [rotation, velocity, position] (9); bias order: [gyro, accel] (6).
/// The samples are kept, so the integral can be redone about another bias.
class PreintegratedImu {
 public:
  /// @param samples  time-ordered; measurement k is interpolated at the ends so that exactly
  ///                 [begin_ns, end_ns] is covered; an uncovered start or end extrapolates the
  ///                 nearest sample.
  /// @throws InvalidArgument on end_ns <= begin_ns, no samples, or non-finite values.
  PreintegratedImu(std::span<const ImuSample> samples, Nanoseconds begin_ns, Nanoseconds end_ns,
                   const ImuBias& bias, const ImuCalibration& noise);

  /// This interval followed by `next` (next.begin_ns() == end_ns()), about this bias.
  PreintegratedImu joined(const PreintegratedImu& next) const;
  /// The same interval integrated about another bias.
  PreintegratedImu rebased(const ImuBias& bias) const;

  Nanoseconds begin_ns() const { return begin_ns_; }
  Nanoseconds end_ns() const { return end_ns_; }
  double duration_s() const { return to_seconds(end_ns_ - begin_ns_); }
  const ImuBias& bias() const { return bias_; }  ///< bias of the linearisation
  std::span<const ImuSample> samples() const { return samples_; }
  const ImuCalibration& noise() const { return noise_; }

  /// Increments corrected to first order for `bias`.
  Eigen::Quaterniond delta_rotation(const ImuBias& bias) const;
  Vector3d delta_velocity(const ImuBias& bias) const;
  Vector3d delta_position(const ImuBias& bias) const;

  /// State at end_ns from the state at begin_ns; gravity is kGravityWorld. The bias is carried
  /// over.
  NavState predict(const NavState& from) const;

  /// Covariance of [rotation, velocity, position], 9x9, and bias random-walk variances over the
  /// interval.
  const Eigen::Matrix<double, 9, 9>& covariance() const { return covariance_; }
  double gyro_bias_variance() const;   ///< rad^2 / s^2, each axis
  double accel_bias_variance() const;  ///< m^2 / s^4, each axis

  const Matrix3d& d_rotation_d_gyro_bias() const { return dR_dbg_; }
  const Matrix3d& d_velocity_d_gyro_bias() const { return dV_dbg_; }
  const Matrix3d& d_velocity_d_accel_bias() const { return dV_dba_; }
  const Matrix3d& d_position_d_gyro_bias() const { return dP_dbg_; }
  const Matrix3d& d_position_d_accel_bias() const { return dP_dba_; }

 private:
  void integrate();

  std::vector<ImuSample> samples_;
  Nanoseconds begin_ns_ = 0, end_ns_ = 0;
  ImuBias bias_;
  ImuCalibration noise_;
  Eigen::Quaterniond delta_R_ = Eigen::Quaterniond::Identity();
  Vector3d delta_v_ = Vector3d::Zero(), delta_p_ = Vector3d::Zero();
  Matrix3d dR_dbg_, dV_dbg_, dV_dba_, dP_dbg_, dP_dba_;
  Eigen::Matrix<double, 9, 9> covariance_;
};

}  // namespace fastloop
