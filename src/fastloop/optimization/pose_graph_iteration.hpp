#pragma once

#include <algorithm>
#include <cmath>

#include "fastloop/optimization/pose_graph.hpp"

/// The iteration that the block solver and the device share, see docs/pose-graph.md.
namespace fastloop::optimization {

struct IterationRule {
  double floor = 0;          ///< costs below are zero up to rounding
  double damping_scale = 1;  ///< size of the largest diagonal entries of the normal equations
  /// Share of the cost that the quadratic model may have failed to foresee if refining is to be
  /// tried.
  double max_excess = 0.3;
};

/// `Steps` computes:
///   bool has_unknowns(), double initial_cost()
///   bool factor(double lambda, double& expected)  factorisation and step at the present poses;
///                                                 false: not positive definite
///   double refine()         step with the old factor; both steps give the decrease to be expected
///   double candidate_cost() cost where the step leads
///   void accept()           goes there
template <class Steps>
class PoseGraphIteration {
 public:
  PoseGraphIteration(Steps& steps, const IterationRule& rule, const PoseGraphOptions& options,
                     PoseGraphResult& result)
      : steps_(steps), rule_(rule), options_(options), result_(result) {}

  void run() {
    cost_ = steps_.initial_cost();
    result_.cost_history.push_back(cost_);
    result_.status = PoseGraphStatus::kMaxIterations;
    result_.reason = "ended by max_iterations";
    if (!steps_.has_unknowns() || !(cost_ > rule_.floor) || descend()) {
      result_.status = PoseGraphStatus::kConverged;
      result_.reason.clear();
    }
    result_.final_cost = cost_;
  }

 private:
  static constexpr int kMaxRejections = 12;       // in a row
  static constexpr int kMaxRefinements = 6;       // steps with an old factor
  static constexpr double kWorthRefining = 0.05;  // contraction of the expected decrease per step

  /// True: converged.
  bool descend() {
    const double tolerance = options_.relative_tolerance;
    double lambda = 0;
    int rejections = 0;
    while (result_.iterations < options_.max_iterations) {
      double expected = 0;
      const bool positive_definite = steps_.factor(lambda, expected);
      ++result_.factorizations;
      const double before = cost_;
      if (positive_definite && try_step()) {
        ++result_.iterations;
        rejections = 0;
        const double decrease = before - cost_;
        const bool small = decrease <= tolerance * cost_ && expected <= 10 * tolerance * before;
        // A step whose effect was foretold this well met no curvature that another step could use.
        const bool foretold = std::abs(decrease - expected) <= 0.1 * tolerance * cost_;
        if (cost_ <= rule_.floor || ((small || foretold) && lambda == 0)) return true;
        if (lambda == 0 && decrease > 0.5 * expected && refine(expected, before - expected))
          return true;
        lambda = lambda > 1e-6 * rule_.damping_scale ? 0.1 * lambda : 0;
        continue;
      }
      // What is left is rounding.
      if (positive_definite && lambda == 0 && expected <= 1e-10 * cost_ + rule_.floor) return true;
      if (++rejections > kMaxRejections) {
        result_.status = PoseGraphStatus::kStalled;
        result_.reason = "no step lowers the cost any more";
        return false;
      }
      lambda = std::max(10 * lambda, 1e-6 * rule_.damping_scale);
    }
    return false;
  }

  /// Moves along the present step if that lowers the cost.
  bool try_step() {
    const double candidate = steps_.candidate_cost();
    if (!(candidate < cost_)) return false;
    steps_.accept();
    cost_ = candidate;
    result_.cost_history.push_back(cost_);
    return true;
  }

  /// Steps with the gradient at the new poses and the factor of the old ones. Near the minimum the
  /// expected decrease shrinks by a constant factor per step at a fraction of the price of a
  /// factorisation. `foreseen` is the cost that the quadratic model expected after the step; where
  /// the true cost lies far above it, the old factor says little about the new place. True:
  /// converged.
  bool refine(double last_decrease, double foreseen) {
    if (cost_ - foreseen > rule_.max_excess * cost_) return false;
    for (int k = 0; k < kMaxRefinements; ++k) {
      const double decrease = steps_.refine();
      const double contraction = decrease / last_decrease;
      if (!(contraction < kWorthRefining) || decrease > cost_) return false;
      const bool done =
          decrease * std::max(contraction, 1e-2) <= options_.relative_tolerance * cost_;
      if (!try_step()) return decrease <= options_.relative_tolerance * cost_;
      if (done) return true;
      last_decrease = decrease;
    }
    return false;
  }

  Steps& steps_;
  const IterationRule& rule_;
  const PoseGraphOptions& options_;
  PoseGraphResult& result_;
  double cost_ = 0;
};

}  // namespace fastloop::optimization
