#include "fastloop/optimization/similarity_refinement.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>

namespace fastloop::optimization {
namespace {

/// Normal equations about S -> exp(d) * S.
struct Terms {
  Matrix7d hessian = Matrix7d::Zero();
  Vector7d gradient = Vector7d::Zero();
  double cost = 0;
};

/// Squared normalised error of one reprojection, infinite when the camera does not see the point.
double error_of(const Camera& camera, const Vector3d& p, const Eigen::Vector2d& pixel,
                double inv_sigma2) {
  if (!camera.is_projectable(p)) return std::numeric_limits<double>::infinity();
  return inv_sigma2 * (camera.project(p) - pixel).squaredNorm();
}

/// What both ways of differentiating share: the pairs and which of them still count.
class Pairs {
 public:
  Pairs(const Camera& camera, std::span<const SimilarityPair> pairs,
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

 protected:
  /// Adds the cost of one squared, normalised error and returns its weight.
  double weigh(Terms& t, double squared, bool robust) const {
    if (!robust || squared <= options_.chi2_gate) {
      t.cost += squared;
      return 1;
    }
    const double norm = std::sqrt(squared), width = std::sqrt(options_.chi2_gate);
    t.cost += 2 * width * norm - options_.chi2_gate;
    return width / norm;
  }
  /// Of a point that its camera does not see.
  double lost_cost() const { return 4 * options_.chi2_gate; }

  const Camera& camera_;
  std::span<const SimilarityPair> pairs_;
  const SimilarityOptions& options_;
  std::vector<std::uint8_t> active_;
};

/// One row of a residual into the upper triangle of the normal equations.
void add_row(Terms& t, const Vector7d& j, double weight, double residual) {
  for (int col = 0; col < 7; ++col) {
    const double scaled = weight * j[col];
    for (int row = 0; row <= col; ++row) t.hessian(row, col) += scaled * j[row];
    t.gradient[col] += scaled * residual;
  }
}

void complete(Terms& t) {
  for (int row = 1; row < 7; ++row)
    for (int col = 0; col < row; ++col) t.hessian(row, col) = t.hessian(col, row);
}

/// With analytic derivatives. Sums over blocks of pairs, so that they are the same whoever forms them.
class Problem : public Pairs {
 public:
  static constexpr double kNoStep = 1e-9;  ///< a step this small ends the search

  Problem(const Camera& camera, std::span<const SimilarityPair> pairs,
          const SimilarityOptions& options, const Executor& executor)
      : Pairs(camera, pairs, options),
        executor_(executor),
        blocks_((pairs.size() + kBlock - 1) / kBlock) {
    R_view_.reserve(pairs.size());
    for (const SimilarityPair& p : pairs) R_view_.push_back(p.T_view_second.rotation.toRotationMatrix());
  }

  Terms linearise(const Sim3& s, bool robust) {
    const Sim3 inverse = s.inverse();
    const Matrix3d there = s.scale * s.rotation.toRotationMatrix();
    const Matrix3d back = inverse.scale * inverse.rotation.toRotationMatrix();
    executor_.for_ranges(blocks_.size(), 1, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin) {
        Terms t;
        const std::size_t last = std::min((begin + 1) * kBlock, pairs_.size());
        for (std::size_t i = begin * kBlock; i < last; ++i) {
          if (!active_[i]) continue;
          const SimilarityPair& p = pairs_[i];
          const Vector3d p_first = there * p.p_second + s.translation;
          add(t, p_first, p_first, Matrix3d::Identity(), p.pixel_first, p.inv_sigma2_first, robust);
          // S^-1 exp(-d) p moves by -S^-1's linear part times the perturbation of p.
          const Vector3d p_view =
              R_view_[i] * (back * p.p_first + inverse.translation) + p.T_view_second.translation;
          add(t, p_view, p.p_first, -(R_view_[i] * back), p.pixel_view, p.inv_sigma2_view, robust);
        }
        blocks_[begin] = t;
      }
    });
    Terms sum;
    for (const Terms& t : blocks_) {
      sum.hessian += t.hessian;
      sum.gradient += t.gradient;
      sum.cost += t.cost;
    }
    complete(sum);
    return sum;
  }

 private:
  /// One reprojection of `p_seen`, which moves by `linear` times the perturbation of `p`:
  /// d (exp(d) * p) / d d = [-hat(p), I, p] in the order rotation, translation, log scale.
  void add(Terms& t, const Vector3d& p_seen, const Vector3d& p, const Matrix3d& linear,
           const Eigen::Vector2d& pixel, double inv_sigma2, bool robust) const {
    if (!camera_.is_projectable(p_seen)) {
      t.cost += lost_cost();
      return;
    }
    Eigen::Matrix<double, 2, 3> d_pixel;
    const Eigen::Vector2d r = camera_.project(p_seen, &d_pixel) - pixel;
    const double weight = inv_sigma2 * weigh(t, inv_sigma2 * r.squaredNorm(), robust);
    const Eigen::Matrix<double, 2, 3> d_point = d_pixel * linear;
    for (int k = 0; k < 2; ++k) {
      const Vector3d g = d_point.row(k);
      Vector7d j;
      j << p.cross(g), g, g.dot(p);
      add_row(t, j, weight, r[k]);
    }
  }

  static constexpr std::size_t kBlock = 32;  ///< pairs

  const Executor& executor_;
  std::vector<Matrix3d> R_view_;  ///< [pairs] of T_view_second
  std::vector<Terms> blocks_;
};

/// As published: with central differences, every reprojection anew for each of them, and always as
/// many iterations as allowed.
class NumericProblem : public Pairs {
 public:
  static constexpr double kNoStep = 0;  ///< only the number of iterations ends the search

  using Pairs::Pairs;

  Terms linearise(const Sim3& s, bool robust) const {
    Terms t;
    std::array<Sim3, 14> moved, inverse;  // forwards and backwards along each unknown
    for (int k = 0; k < 14; ++k) {
      Vector7d d = Vector7d::Zero();
      d[k / 2] = k % 2 == 0 ? kStep : -kStep;
      const auto at = static_cast<std::size_t>(k);
      moved[at] = Sim3::exp(d) * s;
      inverse[at] = moved[at].inverse();
    }
    const Sim3 s_inverse = s.inverse();
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      if (!active_[i]) continue;
      const SimilarityPair& p = pairs_[i];
      const auto forth = [&](const Sim3& x) -> Vector3d { return x * p.p_second; };
      const auto back = [&](const Sim3& x) -> Vector3d {
        return p.T_view_second * (x * p.p_first);
      };
      add(t, s, moved, forth, p.pixel_first, p.inv_sigma2_first, robust);
      add(t, s_inverse, inverse, back, p.pixel_view, p.inv_sigma2_view, robust);
    }
    complete(t);
    return t;
  }

 private:
  static constexpr double kStep = 1e-6;

  template <class PointIn>
  void add(Terms& t, const Sim3& s, const std::array<Sim3, 14>& moved, const PointIn& point_in,
           const Eigen::Vector2d& pixel, double inv_sigma2, bool robust) const {
    const Vector3d p = point_in(s);
    if (!camera_.is_projectable(p)) {
      t.cost += lost_cost();
      return;
    }
    const Eigen::Vector2d r = camera_.project(p) - pixel;
    Eigen::Matrix<double, 2, 7> j;
    for (int k = 0; k < 7; ++k) {
      const auto ahead = static_cast<std::size_t>(2 * k);
      j.col(k) = (camera_.project(point_in(moved[ahead])) -
                  camera_.project(point_in(moved[ahead + 1]))) / (2 * kStep);
    }
    const double weight = inv_sigma2 * weigh(t, inv_sigma2 * r.squaredNorm(), robust);
    for (int k = 0; k < 2; ++k) add_row(t, j.row(k), weight, r[k]);
  }
};

template <class AnyProblem>
void minimise(AnyProblem& problem, Sim3& s, int iterations, bool robust, bool fixed_scale) {
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
    const double length = step.norm();
    if (length < AnyProblem::kNoStep) {
      s = next;
      return;
    }
    const Terms there = problem.linearise(next, robust);
    // Steps this short end below what the cost can tell, but not below what the gradient can: both
    // ways of differentiating arrive at the same place to 1e-9.
    if (there.cost < now.cost || length < 1e-6) {
      s = next;
      now = there;
      lambda = std::max(1e-9, lambda * 0.1);
    } else {
      lambda = std::max(1e-4, lambda * 10);
    }
  }
}

template <class AnyProblem>
SimilarityResult refine(AnyProblem problem, const Sim3& initial,
                        std::span<const SimilarityPair> pairs, const SimilarityOptions& options) {
  SimilarityResult result;
  result.S_first_second = initial;
  result.inlier.assign(pairs.size(), 0);
  Sim3 s = initial;
  if (static_cast<int>(pairs.size()) < options.min_pairs || !s.is_finite()) return result;
  minimise(problem, s, options.iterations, true, options.fixed_scale);
  const int left = problem.classify(s);
  if (left < options.min_pairs) return result;
  const bool dropped = left < static_cast<int>(pairs.size());
  minimise(problem, s, dropped ? options.iterations_after_gate : options.iterations, false,
           options.fixed_scale);
  result.num_inliers = problem.classify(s);
  if (result.num_inliers < options.min_pairs) {
    result.num_inliers = 0;
    return result;
  }
  result.S_first_second = s;
  result.inlier = problem.active();
  return result;
}

}  // namespace

SimilarityResult refine_similarity(const Camera& camera, const Sim3& initial_S_first_second,
                                   std::span<const SimilarityPair> pairs,
                                   const SimilarityOptions& options, const Executor& executor) {
  return refine(Problem(camera, pairs, options, executor), initial_S_first_second, pairs, options);
}

SimilarityResult refine_similarity_reference(const Camera& camera,
                                             const Sim3& initial_S_first_second,
                                             std::span<const SimilarityPair> pairs,
                                             const SimilarityOptions& options) {
  return refine(NumericProblem(camera, pairs, options), initial_S_first_second, pairs, options);
}

}  // namespace fastloop::optimization
