#include "fastloop/optimization/similarity_refinement.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

namespace fastloop::optimization {
namespace {

/// Normal equations about S -> exp(d) * S.
struct Terms {
  Matrix7d hessian = Matrix7d::Zero();
  Vector7d gradient = Vector7d::Zero();
  double cost = 0;
};

using PointJacobian = Eigen::Matrix<double, 3, 7>;

/// d (exp(d) * p) / d d at d = 0, in the order rotation, translation, log scale.
PointJacobian perturbation_of(const Vector3d& p) {
  PointJacobian j;
  j.leftCols<3>() = -so3::hat(p);
  j.middleCols<3>(3).setIdentity();
  j.col(6) = p;
  return j;
}

/// Squared normalised error of one reprojection, infinite when the camera does not see the point.
double error_of(const Camera& camera, const Vector3d& p, const Eigen::Vector2d& pixel,
                double inv_sigma2) {
  if (!camera.is_projectable(p)) return std::numeric_limits<double>::infinity();
  return inv_sigma2 * (camera.project(p) - pixel).squaredNorm();
}

class Problem {
 public:
  Problem(const Camera& camera, std::span<const SimilarityPair> pairs,
          const SimilarityOptions& options)
      : camera_(camera), pairs_(pairs), options_(options), active_(pairs.size(), 1) {}

  std::vector<std::uint8_t>& active() { return active_; }

  /// Drops pairs whose error either way is beyond the gate; returns how many are left.
  int classify(const Sim3& s) {
    const Sim3 inverse = s.inverse();
    int left = 0;
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      const SimilarityPair& p = pairs_[i];
      const bool good = error_of(camera_, s * p.p_second, p.pixel_first, p.inv_sigma2_first) <=
                            options_.chi2_gate &&
                        error_of(camera_, p.T_view_second * (inverse * p.p_first), p.pixel_view,
                                 p.inv_sigma2_view) <= options_.chi2_gate;
      active_[i] = active_[i] && good;
      left += active_[i];
    }
    return left;
  }

  Terms linearise(const Sim3& s, bool robust) const {
    Terms t;
    const Sim3 inverse = s.inverse();
    const Matrix3d back = inverse.scale * inverse.rotation.toRotationMatrix();
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      if (!active_[i]) continue;
      const SimilarityPair& p = pairs_[i];
      const Vector3d p_first = s * p.p_second;
      add(t, p_first, perturbation_of(p_first), p.pixel_first, p.inv_sigma2_first, robust);
      // S^-1 exp(-d) p moves by -S^-1's linear part times the perturbation of p.
      const Vector3d p_view = p.T_view_second * (inverse * p.p_first);
      const PointJacobian j =
          -(p.T_view_second.rotation.toRotationMatrix() * back) * perturbation_of(p.p_first);
      add(t, p_view, j, p.pixel_view, p.inv_sigma2_view, robust);
    }
    return t;
  }

 private:
  void add(Terms& t, const Vector3d& p, const PointJacobian& d_point, const Eigen::Vector2d& pixel,
           double inv_sigma2, bool robust) const {
    if (!camera_.is_projectable(p)) {
      t.cost += 4 * options_.chi2_gate;
      return;
    }
    Eigen::Matrix<double, 2, 3> d_pixel;
    const Eigen::Vector2d r = camera_.project(p, &d_pixel) - pixel;
    const double squared = inv_sigma2 * r.squaredNorm(), width = std::sqrt(options_.chi2_gate);
    double weight = inv_sigma2;
    if (robust && squared > options_.chi2_gate) {
      const double norm = std::sqrt(squared);
      t.cost += 2 * width * norm - options_.chi2_gate;
      weight *= width / norm;
    } else {
      t.cost += squared;
    }
    const Eigen::Matrix<double, 2, 7> j = d_pixel * d_point;
    t.hessian.noalias() += weight * j.transpose() * j;
    t.gradient.noalias() += weight * j.transpose() * r;
  }

  const Camera& camera_;
  std::span<const SimilarityPair> pairs_;
  const SimilarityOptions& options_;
  std::vector<std::uint8_t> active_;
};

void minimise(const Problem& problem, Sim3& s, int iterations, bool robust, bool fixed_scale) {
  double lambda = 1e-6;
  Terms now = problem.linearise(s, robust);
  for (int i = 0; i < iterations; ++i) {
    Matrix7d h = now.hessian;
    h.diagonal() *= 1 + lambda;
    Vector7d g = now.gradient;
    if (fixed_scale) {
      h.row(6).setZero();
      h.col(6).setZero();
      h(6, 6) = 1;
      g[6] = 0;
    }
    const Vector7d step = -h.ldlt().solve(g);
    if (!step.allFinite()) return;
    const Sim3 next = Sim3::exp(step) * s;
    const Terms there = problem.linearise(next, robust);
    if (there.cost < now.cost) {
      s = next;
      now = there;
      lambda = std::max(1e-9, lambda * 0.1);
      if (step.norm() < 1e-9) return;
    } else {
      lambda = std::max(1e-4, lambda * 10);
    }
  }
}

}  // namespace

SimilarityResult refine_similarity(const Camera& camera, const Sim3& initial_S_first_second,
                                   std::span<const SimilarityPair> pairs,
                                   const SimilarityOptions& options) {
  SimilarityResult result;
  result.S_first_second = initial_S_first_second;
  result.inlier.assign(pairs.size(), 0);
  Problem problem(camera, pairs, options);
  Sim3 s = initial_S_first_second;
  if (static_cast<int>(pairs.size()) < options.min_pairs || !s.is_finite()) return result;
  minimise(problem, s, options.iterations, true, options.fixed_scale);
  if (problem.classify(s) < options.min_pairs) return result;
  minimise(problem, s, options.iterations_after_gate, false, options.fixed_scale);
  result.num_inliers = problem.classify(s);
  if (result.num_inliers < options.min_pairs) {
    result.num_inliers = 0;
    return result;
  }
  result.S_first_second = s;
  result.inlier = problem.active();
  return result;
}

}  // namespace fastloop::optimization
