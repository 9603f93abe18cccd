#pragma once

#include <ceres/manifold.h>
#include <ceres/sized_cost_function.h>

#include "fastloop/optimization/imu_factor.hpp"
#include "fastloop/optimization/rig_model.hpp"

/// Cost functions of bundle adjustment for Ceres.
///
/// A pose is seven numbers, quaternion (x, y, z, w) and translation of T_world_body. Derivatives
/// are taken by the perturbation of SE3::retract directly: the cost functions write them into the
/// first six of the seven columns and PoseManifold's PlusJacobian hands these columns on ([I; 0]).
/// Ceres only ever uses the product of the two, so nothing is lost and a chain rule through the
/// quaternion is saved.
namespace fastloop::optimization {

inline SE3 pose_from_parameters(const double* p) {
  SE3 T;
  T.rotation = Eigen::Map<const Eigen::Quaterniond>(p);
  T.translation = Eigen::Map<const Vector3d>(p + 4);
  return T;
}

inline void pose_to_parameters(const SE3& T, double* p) {
  Eigen::Map<Eigen::Vector4d>(p, 4) = T.rotation.coeffs();
  Eigen::Map<Vector3d>(p + 4, 3) = T.translation;
}

inline NavState state_from_parameters(const double* pose, const double* velocity,
                                      const double* bias) {
  NavState state;
  state.T_world_body = pose_from_parameters(pose);
  state.v_world = Eigen::Map<const Vector3d>(velocity);
  state.bias.gyro = Eigen::Map<const Vector3d>(bias);
  state.bias.accel = Eigen::Map<const Vector3d>(bias + 3);
  return state;
}

class PoseManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 7; }
  int TangentSize() const override { return 6; }
  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override;
  bool PlusJacobian(const double* x, double* jacobian) const override;
  bool Minus(const double* y, const double* x, double* y_minus_x) const override;
  bool MinusJacobian(const double* x, double* jacobian) const override;
};

/// A pose of which only the tilt is free, about the horizontal axes of the world (2 numbers);
/// position and heading are held. It anchors an inertial problem, where gravity determines roll and
/// pitch but nothing else.
class TiltManifold final : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 7; }
  int TangentSize() const override { return 2; }
  bool Plus(const double* x, const double* delta, double* x_plus_delta) const override;
  bool PlusJacobian(const double* x, double* jacobian) const override;
  bool Minus(const double* y, const double* x, double* y_minus_x) const override;
  bool MinusJacobian(const double* x, double* jacobian) const override;
};

/// What all reprojection errors of a problem share.
struct ReprojectionRig {
  explicit ReprojectionRig(const StereoRig& r)
      : model(r),
        T_left_body(r.T_body_left.inverse()),
        R_left_body(T_left_body.rotation.toRotationMatrix()) {}
  RigModel model;
  SE3 T_left_body;
  Matrix3d R_left_body;
};

/// Reprojection error of one landmark, kRows numbers, whitened. Parameters: pose (7), point (3).
/// The weight (1 / standard deviation) is read at every evaluation and may change between solves;
/// zero takes the observation out without rebuilding the problem.
template <int kRows>
class ReprojectionCost final : public ceres::SizedCostFunction<kRows, 7, 3> {
 public:
  ReprojectionCost(const ReprojectionRig& shared, const PixelObservation& pixel,
                   const double* weight)
      : shared_(&shared), pixel_(pixel), weight_(weight) {}
  bool Evaluate(const double* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  const ReprojectionRig* shared_;
  PixelObservation pixel_;
  const double* weight_;
};

extern template class ReprojectionCost<2>;
extern template class ReprojectionCost<3>;
extern template class ReprojectionCost<4>;

/// Preintegrated IMU and bias random walk between two poses.
/// Parameters: pose (7), velocity (3), bias (6; gyro, accel) of the first state, then of the
/// second.
class ImuCost final : public ceres::SizedCostFunction<15, 7, 3, 6, 7, 3, 6> {
 public:
  explicit ImuCost(const PreintegratedImu& imu) : factor_(imu) {}
  const ImuFactor& factor() const { return factor_; }
  bool Evaluate(const double* const* parameters, double* residuals,
                double** jacobians) const override;

 private:
  ImuFactor factor_;
};

}  // namespace fastloop::optimization
