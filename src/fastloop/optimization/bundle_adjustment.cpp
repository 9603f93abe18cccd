#include "fastloop/optimization/bundle_adjustment.hpp"

#include <ceres/ceres.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <deque>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/bundle_factors.hpp"
#include "fastloop/optimization/reprojection.hpp"

namespace fastloop::optimization {
namespace {

/// Kept cost may exceed the start by this much: two passes with different sets do not end on the
/// very optimum.
constexpr double kCostTolerance = 1e-3;
/// Free poses up to which the reduced system is factorised as a dense matrix, or by a sparse
/// solver.
constexpr int kMaxDensePoses = 60;
constexpr int kMaxDenseInertialPoses = 30;
constexpr int kMaxSparsePoses = 3000;

class CancelCallback final : public ceres::IterationCallback {
 public:
  explicit CancelCallback(const std::atomic<bool>* cancel) : cancel_(cancel) {}
  ceres::CallbackReturnType operator()(const ceres::IterationSummary&) override {
    if (!cancel_ || !cancel_->load(std::memory_order_relaxed)) return ceres::SOLVER_CONTINUE;
    triggered_ = true;
    return ceres::SOLVER_TERMINATE_SUCCESSFULLY;
  }
  bool triggered() const { return triggered_; }

 private:
  const std::atomic<bool>* cancel_;
  bool triggered_ = false;
};

void check_indices(const BundleProblem& problem) {
  const auto in_range = [](int i, std::size_t size) {
    return i >= 0 && static_cast<std::size_t>(i) < size;
  };
  for (const BundleObservation& o : problem.observations)
    if (!in_range(o.pose, problem.poses.size()) || !in_range(o.point, problem.points.size()))
      throw InvalidArgument("bundle observation refers to a pose or point that does not exist");
  for (const BundleImuEdge& e : problem.imu_edges)
    if (!in_range(e.from, problem.poses.size()) || !in_range(e.to, problem.poses.size()) ||
        e.from == e.to || !e.imu)
      throw InvalidArgument("bundle IMU edge needs two different poses and measurements");
}

bool is_finite(const NavState& s) {
  return s.T_world_body.is_finite() && s.v_world.allFinite() && s.bias.gyro.allFinite() &&
         s.bias.accel.allFinite();
}

bool is_finite(const StereoRig& rig, const BundleObservation& o) {
  const bool right = !o.pixel.has_right() ||
                     (rig.kind == StereoRig::Kind::kRectified ? std::isfinite(o.pixel.right.x())
                                                              : o.pixel.right.allFinite());
  return right && o.pixel.left.allFinite() && std::isfinite(o.inv_sigma2) && o.inv_sigma2 > 0;
}

double huber(double chi2, double gate) {
  return chi2 <= gate ? chi2 : 2.0 * std::sqrt(gate * chi2) - gate;
}

/// One adjustment: owns the parameter blocks and the cost functions that Ceres points into.
class Adjustment {
 public:
  Adjustment(const BundleProblem& problem, const BundleOptions& options)
      : input_(problem),
        options_(options),
        shared_(problem.rig),
        states_(problem.poses.size()),
        points_(problem.points),
        weights_(problem.observations.size()) {
    for (std::size_t i = 0; i < states_.size(); ++i) {
      const NavState& s = problem.poses[i].state;
      pose_to_parameters(s.T_world_body, states_[i].pose.data());
      Eigen::Map<Eigen::Matrix<double, 9, 1>>(states_[i].motion.data(), 9) << s.v_world,
          s.bias.gyro, s.bias.accel;
    }
  }

  BundleResult run(BundleProblem& output);

 private:
  /// Parameter blocks of one keyframe. They lie in one array, because Ceres eliminates blocks in
  /// the order of their addresses: two arrays would be at the mercy of the heap, and with them the
  /// last bits of the result.
  struct State {
    std::array<double, 7> pose;
    std::array<double, 9> motion;  ///< velocity, gyro bias, accel bias
  };

  void build();
  void add_observations();
  void add_imu_edges();
  void fix_blocks();
  BundleSolver linear_solver() const;
  ceres::Solver::Options solver_options(int iterations, double seconds, bool only_to_gate) const;
  bool solve(int iterations, bool only_to_gate, BundleResult* result);
  void set_weights(bool gate);
  double chi2(std::size_t observation, int* size) const;
  double kept_cost() const;
  bool is_state_finite() const;
  void write(BundleProblem& output) const;

  const BundleProblem& input_;
  const BundleOptions& options_;
  ReprojectionRig shared_;
  std::vector<State> states_;     ///< parameter blocks
  std::vector<Vector3d> points_;  ///< parameter blocks
  std::vector<double> weights_;   ///< [observations] 0 = left out
  std::vector<std::uint8_t> point_used_, pose_used_;
  int num_free_poses_ = 0;
  Stopwatch watch_;

  PoseManifold manifold_;
  TiltManifold tilt_manifold_;
  std::deque<ReprojectionCost<2>> costs2_;
  std::deque<ReprojectionCost<3>> costs3_;
  std::deque<ReprojectionCost<4>> costs4_;
  std::vector<std::uint8_t> observation_used_;
  std::deque<ImuCost> imu_costs_;
  ceres::HuberLoss huber2_{std::sqrt(chi2_gate(2))}, huber3_{std::sqrt(chi2_gate(3))},
      huber4_{std::sqrt(chi2_gate(4))};
  std::unique_ptr<ceres::Problem> problem_;
};

void Adjustment::build() {
  ceres::Problem::Options options;
  options.cost_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  options.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  options.disable_all_safety_checks = true;
  problem_ = std::make_unique<ceres::Problem>(options);
  pose_used_.assign(states_.size(), 0);
  point_used_.assign(points_.size(), 0);
  add_observations();
  add_imu_edges();
  fix_blocks();
}

void Adjustment::add_observations() {
  observation_used_.assign(input_.observations.size(), 0);
  for (std::size_t i = 0; i < input_.observations.size(); ++i) {
    const BundleObservation& o = input_.observations[i];
    if (!is_finite(input_.rig, o) || !points_[o.point].allFinite()) continue;
    observation_used_[i] = 1;
    ceres::CostFunction* cost = nullptr;
    ceres::LossFunction* loss = nullptr;
    switch (input_.rig.residual_size(o.pixel)) {
      case 2:
        cost = &costs2_.emplace_back(shared_, o.pixel, &weights_[i]);
        loss = &huber2_;
        break;
      case 3:
        cost = &costs3_.emplace_back(shared_, o.pixel, &weights_[i]);
        loss = &huber3_;
        break;
      default:
        cost = &costs4_.emplace_back(shared_, o.pixel, &weights_[i]);
        loss = &huber4_;
    }
    double* const pose = states_[o.pose].pose.data();
    if (!pose_used_[o.pose]) problem_->AddParameterBlock(pose, 7, &manifold_);
    pose_used_[o.pose] = point_used_[o.point] = 1;
    problem_->AddResidualBlock(cost, options_.robust ? loss : nullptr, pose,
                               points_[o.point].data());
  }
}

void Adjustment::add_imu_edges() {
  for (const BundleImuEdge& e : input_.imu_edges) {
    for (const int i : {e.from, e.to}) {
      if (!pose_used_[i]) problem_->AddParameterBlock(states_[i].pose.data(), 7, &manifold_);
      pose_used_[i] = 1;
    }
    ImuCost* const imu_cost = &imu_costs_.emplace_back(*e.imu);
    problem_->AddResidualBlock(imu_cost, nullptr, states_[e.from].pose.data(),
                               states_[e.from].motion.data(), states_[e.from].motion.data() + 3,
                               states_[e.to].pose.data(), states_[e.to].motion.data(),
                               states_[e.to].motion.data() + 3);
  }
}

void Adjustment::fix_blocks() {
  bool any_fixed = false;
  for (std::size_t i = 0; i < states_.size(); ++i) {
    if (!pose_used_[i]) continue;
    any_fixed |= input_.poses[i].pose_fixed;
    num_free_poses_ += !input_.poses[i].pose_fixed;
    if (input_.poses[i].pose_fixed) problem_->SetParameterBlockConstant(states_[i].pose.data());
    if (input_.poses[i].motion_fixed && problem_->HasParameterBlock(states_[i].motion.data())) {
      problem_->SetParameterBlockConstant(states_[i].motion.data());
      problem_->SetParameterBlockConstant(states_[i].motion.data() + 3);
    }
  }
  // Somebody has to hold the world in place: the first pose does when the caller fixed none. With
  // IMU measurements its roll and pitch must stay free to follow gravity.
  for (std::size_t i = 0; i < states_.size() && !any_fixed; ++i) {
    if (!pose_used_[i]) continue;
    if (input_.imu_edges.empty()) {
      problem_->SetParameterBlockConstant(states_[i].pose.data());
    } else {
      problem_->SetManifold(states_[i].pose.data(), &tilt_manifold_);
    }
    any_fixed = true;
  }
}

BundleSolver Adjustment::linear_solver() const {
  if (options_.solver != BundleSolver::kAuto) return options_.solver;
  const bool inertial = !input_.imu_edges.empty();
  if (num_free_poses_ <= (inertial ? kMaxDenseInertialPoses : kMaxDensePoses))
    return BundleSolver::kDense;
  return num_free_poses_ <= kMaxSparsePoses ? BundleSolver::kSparse : BundleSolver::kIterative;
}

ceres::Solver::Options Adjustment::solver_options(int iterations, double seconds,
                                                  bool only_to_gate) const {
  ceres::Solver::Options options;
  switch (linear_solver()) {
    case BundleSolver::kSparse:
      options.linear_solver_type = ceres::SPARSE_SCHUR;
      break;
    case BundleSolver::kIterative:
      options.linear_solver_type = ceres::ITERATIVE_SCHUR;
      options.preconditioner_type = ceres::SCHUR_JACOBI;
      break;
    default:
      options.linear_solver_type = ceres::DENSE_SCHUR;
  }
  // In a local problem a relative decrease of 1e-5 is a small part of one standard deviation, and a
  // pass that only has to tell outliers needs less. Large problems advance in small steps: be
  // patient.
  const bool local = options.linear_solver_type == ceres::DENSE_SCHUR;
  options.function_tolerance = !local ? 1e-6 : only_to_gate ? 1e-3 : 1e-5;
  options.max_num_iterations = iterations;
  options.num_threads = options_.threads;
  options.logging_type = ceres::SILENT;
  if (seconds > 0) options.max_solver_time_in_seconds = seconds;

  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  for (std::size_t i = 0; i < points_.size(); ++i)
    if (point_used_[i]) ordering->AddElementToGroup(const_cast<double*>(points_[i].data()), 0);
  for (std::size_t i = 0; i < states_.size(); ++i) {
    if (!pose_used_[i]) continue;
    ordering->AddElementToGroup(const_cast<double*>(states_[i].pose.data()), 1);
    double* const motion = const_cast<double*>(states_[i].motion.data());
    if (!problem_->HasParameterBlock(motion)) continue;
    ordering->AddElementToGroup(motion, 1);
    ordering->AddElementToGroup(motion + 3, 1);
  }
  options.linear_solver_ordering = std::move(ordering);
  return options;
}

/// False when Ceres could not produce a usable state; `result->reason` says why.
bool Adjustment::solve(int iterations, bool only_to_gate, BundleResult* result) {
  double seconds = 0;
  if (options_.max_seconds > 0) {
    seconds = options_.max_seconds - 1e-3 * watch_.elapsed_ms();
    if (seconds <= 0) return true;
  }
  ceres::Solver::Options options = solver_options(iterations, seconds, only_to_gate);
  CancelCallback cancel(options_.cancel);
  options.callbacks.push_back(&cancel);
  ceres::Solver::Summary summary;
  ceres::Solve(options, problem_.get(), &summary);
  result->iterations += static_cast<int>(summary.iterations.size());
  result->cancelled |= cancel.triggered();
  if (!summary.IsSolutionUsable()) result->reason = summary.message;
  return summary.IsSolutionUsable();
}

double Adjustment::chi2(std::size_t i, int* size) const {
  const BundleObservation& o = input_.observations[i];
  const Vector3d p_body =
      pose_from_parameters(states_[o.pose].pose.data()).inverse() * points_[o.point];
  StereoRig::Residual r;
  *size = shared_.model.residual(shared_.T_left_body * p_body, o.pixel, &r);
  double sum = 0;
  for (int k = 0; k < *size; ++k) sum += r(k) * r(k);
  return o.inv_sigma2 * sum;
}

/// Leaves out what cannot be projected and, with `gate`, what fails chi2_gate at the present state.
void Adjustment::set_weights(bool gate) {
  for (std::size_t i = 0; i < weights_.size(); ++i) {
    weights_[i] = 0;
    if (!observation_used_[i]) continue;
    int size = 0;
    const double value = chi2(i, &size);
    if (size > 0 && (!gate || value <= chi2_gate(size)))
      weights_[i] = std::sqrt(input_.observations[i].inv_sigma2);
  }
}

/// Robust cost of the observations that were not left out, and of the IMU edges, at the present
/// state.
double Adjustment::kept_cost() const {
  double sum = 0;
  for (std::size_t i = 0; i < weights_.size(); ++i) {
    if (weights_[i] == 0) continue;
    int size = 0;
    const double value = chi2(i, &size);
    const double gate = chi2_gate(input_.rig.residual_size(input_.observations[i].pixel));
    if (size == 0) {
      sum += kBehindCameraPenalty * gate;
    } else {
      sum += options_.robust ? huber(value, gate) : value;
    }
  }
  for (std::size_t i = 0; i < imu_costs_.size(); ++i) {
    const BundleImuEdge& e = input_.imu_edges[i];
    const auto state = [&](int k) {
      return state_from_parameters(states_[k].pose.data(), states_[k].motion.data(),
                                   states_[k].motion.data() + 3);
    };
    sum += imu_costs_[i].factor().residual(state(e.from), state(e.to)).squaredNorm();
  }
  return 0.5 * sum;
}

bool Adjustment::is_state_finite() const {
  const auto finite = [](const auto& block) {
    return std::all_of(block.begin(), block.end(), [](double v) { return std::isfinite(v); });
  };
  for (std::size_t i = 0; i < points_.size(); ++i)
    if (point_used_[i] && !points_[i].allFinite()) return false;
  return std::all_of(states_.begin(), states_.end(),
                     [&](const State& s) { return finite(s.pose) && finite(s.motion); });
}

void Adjustment::write(BundleProblem& output) const {
  for (std::size_t i = 0; i < states_.size(); ++i) {
    if (!pose_used_[i]) continue;
    const NavState s = state_from_parameters(states_[i].pose.data(), states_[i].motion.data(),
                                             states_[i].motion.data() + 3);
    // Blocks that were held are left as they were, to the last bit.
    NavState& target = output.poses[i].state;
    if (!problem_->IsParameterBlockConstant(states_[i].pose.data()))
      target.T_world_body = SE3(s.T_world_body.rotation, s.T_world_body.translation);
    target.v_world = s.v_world;
    target.bias = s.bias;
  }
  output.points = points_;
}

BundleResult Adjustment::run(BundleProblem& output) {
  BundleResult result;
  result.outlier.assign(weights_.size(), 0);
  build();
  set_weights(false);
  if (problem_->NumResidualBlocks() == 0) {
    std::fill(result.outlier.begin(), result.outlier.end(), 1);
    result.reason = "no usable observations";
    return result;
  }
  auto states = states_;
  auto points = points_;
  const auto exchange_with_start = [&] {
    // The blocks keep their addresses, which Ceres knows.
    std::swap_ranges(states_.begin(), states_.end(), states.begin());
    std::swap_ranges(points_.begin(), points_.end(), points.begin());
  };
  bool usable = solve(options_.iterations, options_.iterations_after_gate > 0, &result);
  if (usable && !result.cancelled && options_.iterations_after_gate > 0) {
    set_weights(true);
    usable = solve(options_.iterations_after_gate, false, &result);
  }
  result.final_cost = kept_cost();
  exchange_with_start();
  result.initial_cost = kept_cost();
  exchange_with_start();

  if (usable && !(is_state_finite() && std::isfinite(result.final_cost))) {
    usable = false;
    result.reason = "result is not finite";
  } else if (usable &&
             result.final_cost > result.initial_cost * (1 + kCostTolerance) + kCostTolerance) {
    usable = false;
    result.reason = "cost rose";
  }
  if (!usable) exchange_with_start();
  set_weights(true);
  for (std::size_t i = 0; i < weights_.size(); ++i) result.outlier[i] = weights_[i] == 0;
  if (usable) write(output);
  result.usable = usable;
  return result;
}

}  // namespace

void BundleOptions::validate() const {
  if (iterations < 0 || iterations_after_gate < 0)
    throw InvalidArgument("BundleOptions: iterations must not be negative");
  if (threads < 1) throw InvalidArgument("BundleOptions: threads must be at least 1");
  if (!std::isfinite(max_seconds) || max_seconds < 0)
    throw InvalidArgument("BundleOptions: max_seconds must be finite and not negative");
}

BundleResult adjust_bundle(BundleProblem& problem, const BundleOptions& options) {
  options.validate();
  check_indices(problem);
  for (std::size_t i = 0; i < problem.poses.size(); ++i) {
    if (is_finite(problem.poses[i].state)) continue;
    BundleResult result;
    result.reason = "pose " + std::to_string(i) + " is not finite";
    result.outlier.assign(problem.observations.size(), 0);
    return result;
  }
  return Adjustment(problem, options).run(problem);
}

}  // namespace fastloop::optimization
