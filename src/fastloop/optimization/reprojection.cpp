#include "fastloop/optimization/reprojection.hpp"

#include <cmath>

#include "fastloop/optimization/rig_model.hpp"

namespace fastloop::optimization {
namespace {

/// Residual and point Jacobian folded into what the normal equations need of one observation.
struct PointTerms {
  int size = 0;                     ///< rows of the residual, 0: not projectable
  double squared_norm = 0;          ///< unweighted
  Matrix3d jtj = Matrix3d::Zero();  ///< J^T J with J = d residual / d p_left
  Vector3d jtr = Vector3d::Zero();
};

/// Any rig.
struct GeneralModel {
  RigModel rig;

  explicit GeneralModel(const StereoRig& r) : rig(r) {}

  PointTerms terms(const Vector3d& p, const PixelObservation& z) const {
    StereoRig::Residual r = StereoRig::Residual::Zero();
    StereoRig::Jacobian j = StereoRig::Jacobian::Zero();
    PointTerms t;
    t.size = rig.residual(p, z, &r, &j);
    if (t.size == 0) return t;
    t.squared_norm = r.squaredNorm();
    t.jtj.noalias() = j.transpose() * j;
    t.jtr.noalias() = j.transpose() * r;
    return t;
  }

  int squared_norm(const Vector3d& p, const PixelObservation& z, double* value) const {
    StereoRig::Residual r = StereoRig::Residual::Zero();  // rows beyond the size stay zero
    const int size = rig.residual(p, z, &r);
    *value = r.squaredNorm();
    return size;
  }
};

/// Rectified rig with ideal pinholes: the common case, written out because tracking spends its time
/// here.
struct RectifiedModel {
  double fx, fy, cx, cy, fx_baseline;

  explicit RectifiedModel(const StereoRig& rig)
      : fx(rig.left.fx),
        fy(rig.left.fy),
        cx(rig.left.cx),
        cy(rig.left.cy),
        fx_baseline(rig.left.fx * rig.baseline_m) {}

  struct Projected {
    double iz, x, y, r0, r1, r2, disparity;
    bool right;
  };
  bool project(const Vector3d& p, const PixelObservation& z, Projected* o) const {
    if (!(p.z() > 1e-9)) return false;
    o->iz = 1.0 / p.z();
    o->x = p.x() * o->iz;
    o->y = p.y() * o->iz;
    const double u = fx * o->x + cx;
    o->r0 = u - z.left.x();
    o->r1 = fy * o->y + cy - z.left.y();
    o->disparity = fx_baseline * o->iz;
    o->right = z.has_right();
    o->r2 = o->right ? u - o->disparity - z.right.x() : 0.0;
    return true;
  }

  PointTerms terms(const Vector3d& p, const PixelObservation& z) const {
    Projected o;
    PointTerms t;
    if (!project(p, z, &o)) return t;
    // Rows of J: [a 0 c], [0 b d] and, where the right camera saw the point, [a 0 e].
    const double a = fx * o.iz, b = fy * o.iz;
    const double c = -a * o.x, d = -b * o.y;
    const double seen = o.right ? 1.0 : 0.0;
    const double e = seen * (c + o.disparity * o.iz);
    t.size = o.right ? 3 : 2;
    t.squared_norm = o.r0 * o.r0 + o.r1 * o.r1 + o.r2 * o.r2;
    const double m02 = a * (c + e), m12 = b * d;
    t.jtj << a * a * (1.0 + seen), 0, m02, 0, b * b, m12, m02, m12, c * c + d * d + e * e;
    t.jtr << a * (o.r0 + o.r2), b * o.r1, c * o.r0 + d * o.r1 + e * o.r2;
    return t;
  }

  int squared_norm(const Vector3d& p, const PixelObservation& z, double* value) const {
    Projected o;
    if (!project(p, z, &o)) return 0;
    *value = o.r0 * o.r0 + o.r1 * o.r1 + o.r2 * o.r2;
    return o.right ? 3 : 2;
  }
};

/// Adds one observation: with d p_left = hat(p) phi - rho, J = d r / d p_left * [hat(p), -I].
inline void add(const Vector3d& p, const PointTerms& t, double weight, ReprojectionTerms* sum) {
  const Matrix3d m = weight * t.jtj;
  const Vector3d g = weight * t.jtr;
  Matrix3d k;  // hat(p) * m
  for (int c = 0; c < 3; ++c) {
    k(0, c) = p.y() * m(2, c) - p.z() * m(1, c);
    k(1, c) = p.z() * m(0, c) - p.x() * m(2, c);
    k(2, c) = p.x() * m(1, c) - p.y() * m(0, c);
  }
  auto& h = sum->hessian;  // upper triangle only
  h(0, 0) += p.y() * k(0, 2) - p.z() * k(0, 1);
  h(0, 1) += p.z() * k(0, 0) - p.x() * k(0, 2);
  h(0, 2) += p.x() * k(0, 1) - p.y() * k(0, 0);
  h(1, 1) += p.z() * k(1, 0) - p.x() * k(1, 2);
  h(1, 2) += p.x() * k(1, 1) - p.y() * k(1, 0);
  h(2, 2) += p.x() * k(2, 1) - p.y() * k(2, 0);
  h.topRightCorner<3, 3>() += k;
  h(3, 3) += m(0, 0);
  h(3, 4) += m(0, 1);
  h(3, 5) += m(0, 2);
  h(4, 4) += m(1, 1);
  h(4, 5) += m(1, 2);
  h(5, 5) += m(2, 2);
  sum->gradient.head<3>() += g.cross(p);
  sum->gradient.tail<3>() -= g;
}

template <class Model>
ReprojectionTerms accumulate(const Model& model, const SE3& T_left_world,
                             std::span<const PoseObservation> observations,
                             std::span<const std::uint8_t> active, bool robust) {
  const Matrix3d R = T_left_world.rotation.toRotationMatrix();
  const Vector3d t = T_left_world.translation;
  ReprojectionTerms sum;
  for (std::size_t i = 0; i < observations.size(); ++i) {
    if (!active[i]) continue;
    const PoseObservation& o = observations[i];
    const Vector3d p = R * o.p_world + t;
    const PointTerms terms = model.terms(p, o.pixel);
    if (terms.size == 0) {
      sum.cost += kBehindCameraPenalty * chi2_gate(o.pixel.has_right() ? 4 : 2);
      continue;
    }
    const double gate = chi2_gate(terms.size);
    const double chi2 = o.inv_sigma2 * terms.squared_norm;
    double weight = o.inv_sigma2;
    if (robust && chi2 > gate) {
      const double ratio = std::sqrt(gate / chi2);
      weight *= ratio;
      sum.cost += 2.0 * ratio * chi2 - gate;
    } else {
      sum.cost += chi2;
    }
    add(p, terms, weight, &sum);
  }
  sum.hessian.triangularView<Eigen::StrictlyLower>() = sum.hessian.transpose();
  return sum;
}

template <class Model>
int classify(const Model& model, const SE3& T_left_world,
             std::span<const PoseObservation> observations, std::span<const std::uint8_t> usable,
             double gate_scale, std::span<std::uint8_t> inlier) {
  const Matrix3d R = T_left_world.rotation.toRotationMatrix();
  const Vector3d t = T_left_world.translation;
  int count = 0;
  for (std::size_t i = 0; i < observations.size(); ++i) {
    const PoseObservation& o = observations[i];
    inlier[i] = 0;
    if (!usable[i]) continue;
    double squared_norm = 0;
    const int size = model.squared_norm(R * o.p_world + t, o.pixel, &squared_norm);
    inlier[i] = size > 0 && o.inv_sigma2 * squared_norm <= gate_scale * chi2_gate(size);
    count += inlier[i];
  }
  return count;
}

}  // namespace

bool is_usable(const StereoRig& rig, const PoseObservation& o) {
  if (!o.p_world.allFinite() || !o.pixel.left.allFinite()) return false;
  if (!std::isfinite(o.inv_sigma2) || o.inv_sigma2 <= 0) return false;
  if (!o.pixel.has_right()) return true;
  return rig.kind == StereoRig::Kind::kRectified ? std::isfinite(o.pixel.right.x())
                                                 : o.pixel.right.allFinite();
}

ReprojectionTerms accumulate_reprojection(const StereoRig& rig, const SE3& T_left_world,
                                          std::span<const PoseObservation> observations,
                                          std::span<const std::uint8_t> active, bool robust) {
  if (RigModel(rig).is_plain_rectified())
    return accumulate(RectifiedModel(rig), T_left_world, observations, active, robust);
  return accumulate(GeneralModel(rig), T_left_world, observations, active, robust);
}

int classify_by_gate(const StereoRig& rig, const SE3& T_left_world,
                     std::span<const PoseObservation> observations,
                     std::span<const std::uint8_t> usable, double gate_scale,
                     std::span<std::uint8_t> inlier) {
  if (RigModel(rig).is_plain_rectified())
    return classify(RectifiedModel(rig), T_left_world, observations, usable, gate_scale, inlier);
  return classify(GeneralModel(rig), T_left_world, observations, usable, gate_scale, inlier);
}

ReprojectionTerms in_body_frame(const ReprojectionTerms& left, const SE3& T_body_left) {
  const Matrix3d R_left_body = T_body_left.rotation.toRotationMatrix().transpose();
  Matrix6d a = Matrix6d::Zero();  // perturbation of the left camera caused by one of the body
  a.topLeftCorner<3, 3>() = R_left_body;
  a.bottomLeftCorner<3, 3>() = -R_left_body * so3::hat(T_body_left.translation);
  a.bottomRightCorner<3, 3>() = R_left_body;
  ReprojectionTerms body;
  body.hessian = a.transpose() * left.hessian * a;
  body.gradient = a.transpose() * left.gradient;
  body.cost = left.cost;
  return body;
}

}  // namespace fastloop::optimization
