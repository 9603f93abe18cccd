#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop {

int StereoRig::residual(const Vector3d& p_left, const PixelObservation& z, Residual* r,
                        Jacobian* jacobian) const {
  if (!left.is_projectable(p_left)) return 0;
  Eigen::Matrix<double, 2, 3> j;
  r->head<2>() = left.project(p_left, jacobian ? &j : nullptr) - z.left;
  if (jacobian) jacobian->topRows<2>() = j;
  if (!z.has_right()) return 2;
  if (kind == Kind::kRectified) {
    const double iz = 1.0 / p_left.z();
    const double disparity = left.fx * baseline_m * iz;
    (*r)(2) = (*r)(0) + z.left.x() - disparity - z.right.x();
    if (jacobian) {
      jacobian->row(2) = jacobian->row(0);
      (*jacobian)(2, 2) += disparity * iz;
    }
    return 3;
  }
  const Vector3d p_right = T_right_left * p_left;
  if (!right.is_projectable(p_right)) return 0;
  r->segment<2>(2) = right.project(p_right, jacobian ? &j : nullptr) - z.right;
  if (jacobian) jacobian->bottomRows<2>() = j * T_right_left.rotation.toRotationMatrix();
  return 4;
}

}  // namespace fastloop
