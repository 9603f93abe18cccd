#include "fastloop/optimization/bundle_factors.hpp"

#include "fastloop/optimization/reprojection.hpp"

namespace fastloop::optimization {
namespace {

template <int kRows, int kCols>
using RowMajor = Eigen::Matrix<double, kRows, kCols, Eigen::RowMajor>;

/// Splits the derivative by a state into the blocks of its pose, velocity and bias.
void split_state_jacobian(const ImuFactor::Matrix15d& j, double* pose, double* velocity,
                          double* bias) {
  if (pose) {
    Eigen::Map<RowMajor<15, 7>> m(pose);
    m.leftCols<6>() = j.leftCols<6>();
    m.col(6).setZero();
  }
  if (velocity) Eigen::Map<RowMajor<15, 3>>(velocity, 15, 3) = j.middleCols<3>(6);
  if (bias) Eigen::Map<RowMajor<15, 6>>(bias, 15, 6) = j.rightCols<6>();
}

}  // namespace

bool PoseManifold::Plus(const double* x, const double* delta, double* x_plus_delta) const {
  pose_to_parameters(pose_from_parameters(x).retract(Eigen::Map<const Vector6d>(delta)),
                     x_plus_delta);
  return true;
}

bool PoseManifold::PlusJacobian(const double*, double* jacobian) const {
  Eigen::Map<RowMajor<7, 6>>(jacobian, 7, 6).setIdentity();
  return true;
}

bool PoseManifold::Minus(const double* y, const double* x, double* y_minus_x) const {
  Eigen::Map<Vector6d>(y_minus_x, 6) = pose_from_parameters(x).local(pose_from_parameters(y));
  return true;
}

bool PoseManifold::MinusJacobian(const double*, double* jacobian) const {
  Eigen::Map<RowMajor<6, 7>>(jacobian, 6, 7).setIdentity();
  return true;
}

bool TiltManifold::Plus(const double* x, const double* delta, double* x_plus_delta) const {
  const SE3 T = pose_from_parameters(x);
  const Eigen::Quaterniond tilt = so3::exp({delta[0], delta[1], 0});
  pose_to_parameters(SE3(tilt * T.rotation, T.translation), x_plus_delta);
  return true;
}

bool TiltManifold::PlusJacobian(const double* x, double* jacobian) const {
  Eigen::Map<RowMajor<7, 2>> j(jacobian, 7, 2);
  j.setZero();
  // A turn about world axes, seen as the perturbation of SE3::retract.
  const Matrix3d R_body_world = pose_from_parameters(x).rotation.toRotationMatrix().transpose();
  j.topRows<3>() = R_body_world.leftCols<2>();
  return true;
}

bool TiltManifold::Minus(const double* y, const double* x, double* y_minus_x) const {
  const Eigen::Quaterniond turn =
      pose_from_parameters(y).rotation * pose_from_parameters(x).rotation.conjugate();
  Eigen::Map<Eigen::Vector2d>(y_minus_x, 2) = so3::log(turn).head<2>();
  return true;
}

bool TiltManifold::MinusJacobian(const double* x, double* jacobian) const {
  Eigen::Map<RowMajor<2, 7>> j(jacobian, 2, 7);
  j.setZero();
  j.leftCols<3>() = pose_from_parameters(x).rotation.toRotationMatrix().topRows<2>();
  return true;
}

template <int kRows>
bool ReprojectionCost<kRows>::Evaluate(const double* const* parameters, double* residuals,
                                       double** jacobians) const {
  Eigen::Map<Eigen::Matrix<double, kRows, 1>> out(residuals);
  const double weight = *weight_;
  double* const j_pose = jacobians ? jacobians[0] : nullptr;
  double* const j_point = jacobians ? jacobians[1] : nullptr;
  const Matrix3d R = Eigen::Map<const Eigen::Quaterniond>(parameters[0]).toRotationMatrix();
  const Vector3d p_body = R.transpose() * (Eigen::Map<const Vector3d>(parameters[1]) -
                                           Eigen::Map<const Vector3d>(parameters[0] + 4));
  const Vector3d p_left = shared_->R_left_body * p_body + shared_->T_left_body.translation;
  StereoRig::Residual r;
  StereoRig::Jacobian j;
  if (weight == 0 ||
      shared_->model.residual(p_left, pixel_, &r, j_pose || j_point ? &j : nullptr) != kRows) {
    // A point that left the view of its camera costs a constant and pulls at nothing.
    out.setConstant(weight == 0 ? 0 : std::sqrt(kBehindCameraPenalty * chi2_gate(kRows) / kRows));
    if (j_pose) Eigen::Map<RowMajor<kRows, 7>>(j_pose).setZero();
    if (j_point) Eigen::Map<RowMajor<kRows, 3>>(j_point).setZero();
    return true;
  }
  out = weight * r.template head<kRows>();
  if (!j_pose && !j_point) return true;
  const Eigen::Matrix<double, kRows, 3> d_body =
      weight * j.template topRows<kRows>() * shared_->R_left_body;
  if (j_pose) {
    Eigen::Map<RowMajor<kRows, 7>> m(j_pose);
    m.template leftCols<3>() = d_body * so3::hat(p_body);
    m.template middleCols<3>(3) = -d_body;
    m.col(6).setZero();
  }
  if (j_point) Eigen::Map<RowMajor<kRows, 3>>(j_point, kRows, 3) = d_body * R.transpose();
  return true;
}

template class ReprojectionCost<2>;
template class ReprojectionCost<3>;
template class ReprojectionCost<4>;

bool ImuCost::Evaluate(const double* const* p, double* residuals, double** jacobians) const {
  const NavState from = state_from_parameters(p[0], p[1], p[2]);
  const NavState to = state_from_parameters(p[3], p[4], p[5]);
  Eigen::Map<ImuFactor::Vector15d> r(residuals);
  if (!jacobians) {
    r = factor_.residual(from, to);
    return r.allFinite();
  }
  ImuFactor::Matrix15d d_from, d_to;
  r = factor_.residual(from, to, &d_from, &d_to);
  split_state_jacobian(d_from, jacobians[0], jacobians[1], jacobians[2]);
  split_state_jacobian(d_to, jacobians[3], jacobians[4], jacobians[5]);
  return r.allFinite();
}

}  // namespace fastloop::optimization
