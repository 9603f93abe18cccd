#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/imu_factor.hpp"
#include "fastloop/optimization/pose_only.hpp"
#include "fastloop/optimization/reprojection.hpp"

namespace fastloop::optimization {
namespace {

using Vector15d = ImuFactor::Vector15d;
using Matrix15d = ImuFactor::Matrix15d;
using Vector30d = Eigen::Matrix<double, 30, 1>;
using Matrix30d = Eigen::Matrix<double, 30, 30>;

constexpr int kRounds = 4;
constexpr int kIterations = 10;
constexpr double kMinDamping = 1e-9;
constexpr double kFirstDamping = 1e-4;
constexpr double kRoundDecrease = 1e-3;  ///< of the cost, a chi-square; see optimize_pose
constexpr double kLastRoundDecrease = 1e-6;
/// With fewer inliers than this the IMU carries the pose and the landmarks may be off a little:
/// observations up to twice the usual distance are taken back.
constexpr int kFewInliers = 30;
constexpr double kRelaxedGateScale = 4.0;

/// The two states, previous first.
struct States {
  NavState previous, current;
};

struct NormalEquations {
  Matrix30d hessian = Matrix30d::Zero();  ///< previous 0..14, current 15..29
  Vector30d gradient = Vector30d::Zero();
  double cost = 0;
};

bool is_finite(const NavState& s) {
  return s.T_world_body.is_finite() && s.v_world.allFinite() && s.bias.gyro.allFinite() &&
         s.bias.accel.allFinite();
}

class InertialPoseSolver {
 public:
  explicit InertialPoseSolver(const InertialPoseProblem& problem)
      : problem_(problem), factor_(*problem.imu), T_body_left_(problem.rig->T_body_left) {}

  NormalEquations linearize(const States& states, std::span<const std::uint8_t> active,
                            bool robust) const;
  void refine(std::span<const std::uint8_t> active, bool robust, bool last_round,
              States* states) const;
  NavPrior marginal(const States& states, std::span<const std::uint8_t> inlier) const;

 private:
  void add_prior(const NavState& previous, NormalEquations* sum) const;
  Vector30d solve(const NormalEquations& equations, double damping) const;

  const InertialPoseProblem& problem_;
  ImuFactor factor_;
  SE3 T_body_left_;
};

void InertialPoseSolver::add_prior(const NavState& previous, NormalEquations* sum) const {
  if (!problem_.prior) return;
  const NavPrior& prior = *problem_.prior;
  const Vector15d e = local(prior.mean, previous);
  Matrix15d j = Matrix15d::Identity();
  j.topLeftCorner<3, 3>() = so3::right_jacobian_inverse(e.head<3>());
  j.block<3, 3>(3, 3) =
      (prior.mean.T_world_body.rotation.conjugate() * previous.T_world_body.rotation)
          .toRotationMatrix();
  const Matrix15d weighted = j.transpose() * prior.information;
  sum->hessian.topLeftCorner<15, 15>() += weighted * j;
  sum->gradient.head<15>() += weighted * e;
  sum->cost += e.dot(prior.information * e);
}

NormalEquations InertialPoseSolver::linearize(const States& states,
                                              std::span<const std::uint8_t> active,
                                              bool robust) const {
  NormalEquations sum;
  const SE3 T_left_world = (states.current.T_world_body * T_body_left_).inverse();
  const ReprojectionTerms visual = in_body_frame(
      accumulate_reprojection(*problem_.rig, T_left_world, problem_.observations, active, robust),
      T_body_left_);
  sum.hessian.block<6, 6>(15, 15) = visual.hessian;
  sum.gradient.segment<6>(15) = visual.gradient;

  Matrix15d j_previous, j_current;
  const Vector15d r = factor_.residual(states.previous, states.current, &j_previous, &j_current);
  sum.hessian.topLeftCorner<15, 15>() += j_previous.transpose() * j_previous;
  sum.hessian.bottomRightCorner<15, 15>() += j_current.transpose() * j_current;
  sum.hessian.topRightCorner<15, 15>() = j_previous.transpose() * j_current;
  sum.hessian.bottomLeftCorner<15, 15>() = sum.hessian.topRightCorner<15, 15>().transpose();
  sum.gradient.head<15>() += j_previous.transpose() * r;
  sum.gradient.tail<15>() += j_current.transpose() * r;
  sum.cost = visual.cost + r.squaredNorm();
  add_prior(states.previous, &sum);
  return sum;
}

/// Damped Newton step; zero for the previous state where it is held fixed.
Vector30d InertialPoseSolver::solve(const NormalEquations& equations, double damping) const {
  // The unknowns have very different units: solve in units of their own curvature.
  const Vector30d scale = equations.hessian.diagonal().cwiseMax(1e-12).cwiseSqrt().cwiseInverse();
  const Matrix30d h = scale.asDiagonal() * equations.hessian * scale.asDiagonal();
  const Vector30d g = scale.cwiseProduct(equations.gradient);
  Vector30d step = Vector30d::Zero();
  if (problem_.prior) {
    step = -(h + damping * Matrix30d::Identity()).ldlt().solve(g);
  } else {
    const Matrix15d current = h.bottomRightCorner<15, 15>() + damping * Matrix15d::Identity();
    step.tail<15>() = -current.ldlt().solve(g.tail<15>());
  }
  return scale.cwiseProduct(step);
}

void InertialPoseSolver::refine(std::span<const std::uint8_t> active, bool robust, bool last_round,
                                States* states) const {
  double damping = kMinDamping;
  NormalEquations equations = linearize(*states, active, robust);
  for (int i = 0; i < kIterations; ++i) {
    const Vector30d step = solve(equations, damping);
    if (!step.allFinite()) return;
    const States trial{retract(states->previous, step.head<15>()),
                       retract(states->current, step.tail<15>())};
    if (-step.dot(equations.gradient) < (last_round ? kLastRoundDecrease : kRoundDecrease)) {
      if (damping == kMinDamping) *states = trial;
      return;
    }
    const NormalEquations next = linearize(trial, active, robust);
    if (next.cost < equations.cost) {
      *states = trial;
      equations = next;
      damping = std::max(kMinDamping, 0.1 * damping);
    } else {
      damping = std::max(kFirstDamping, 10.0 * damping);
    }
  }
}

/// Nearest symmetric matrix without negative eigenvalues, in units of the diagonal.
Matrix15d positive_semidefinite(const Matrix15d& m) {
  const Vector15d scale = m.diagonal().cwiseMax(1e-12).cwiseSqrt();
  const Vector15d inverse = scale.cwiseInverse();
  const Matrix15d scaled = inverse.asDiagonal() * m * inverse.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Matrix15d> eigen(0.5 * (scaled + scaled.transpose()));
  if (eigen.info() != Eigen::Success) return Matrix15d::Zero();
  const Matrix15d root = scale.asDiagonal() * eigen.eigenvectors() *
                         eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
  const Matrix15d product = root * root.transpose();
  return 0.5 * (product + product.transpose());  // symmetric to the last bit
}

NavPrior InertialPoseSolver::marginal(const States& states,
                                      std::span<const std::uint8_t> inlier) const {
  const NormalEquations equations = linearize(states, inlier, false);
  const Vector30d scale = equations.hessian.diagonal().cwiseMax(1e-12).cwiseSqrt();
  const Vector30d inverse = scale.cwiseInverse();
  const Matrix30d h = inverse.asDiagonal() * equations.hessian * inverse.asDiagonal();
  Matrix15d information = h.bottomRightCorner<15, 15>();
  if (problem_.prior) {
    const Matrix15d previous = h.topLeftCorner<15, 15>() + 1e-12 * Matrix15d::Identity();
    information -=
        h.bottomLeftCorner<15, 15>() * previous.ldlt().solve(Matrix15d(h.topRightCorner<15, 15>()));
  }
  const Vector15d unit = scale.tail<15>();
  NavPrior prior;
  prior.mean = states.current;
  prior.information = positive_semidefinite(unit.asDiagonal() * information * unit.asDiagonal());
  if (!prior.information.allFinite()) prior.information.setZero();
  return prior;
}

}  // namespace

InertialPoseResult optimize_pose_inertial(const InertialPoseProblem& problem) {
  if (!problem.rig || !problem.imu)
    throw InvalidArgument("optimize_pose_inertial needs a rig and IMU measurements");
  InertialPoseResult result;
  result.state = result.prior.mean = problem.initial;
  result.inlier.assign(problem.observations.size(), 0);
  const bool usable_prior =
      !problem.prior || (is_finite(problem.prior->mean) && problem.prior->information.allFinite());
  if (!is_finite(problem.previous) || !usable_prior) return result;

  const InertialPoseSolver solver(problem);
  States states{problem.previous, problem.initial};
  if (!is_finite(states.current)) states.current = problem.imu->predict(problem.previous);

  std::vector<std::uint8_t> usable(problem.observations.size());
  for (std::size_t i = 0; i < usable.size(); ++i)
    usable[i] = is_usable(*problem.rig, problem.observations[i]);
  std::vector<std::uint8_t> active = usable;
  int num_inliers = 0;
  const auto classify = [&](double gate_scale) {
    const SE3 T_left_world = (states.current.T_world_body * problem.rig->T_body_left).inverse();
    num_inliers = classify_by_gate(*problem.rig, T_left_world, problem.observations, usable,
                                   gate_scale, active);
  };
  for (int round = 0; round < kRounds; ++round) {
    const bool last = round == kRounds - 1;
    solver.refine(active, !last, last, &states);
    classify(1.0);
  }
  if (num_inliers < kFewInliers) {
    classify(kRelaxedGateScale);
    solver.refine(active, true, true, &states);
    classify(kRelaxedGateScale);
  }
  if (!is_finite(states.current)) {
    std::fill(result.inlier.begin(), result.inlier.end(), 0);
    return result;
  }
  result.state = states.current;
  result.num_inliers = num_inliers;
  result.prior = solver.marginal(states, active);
  result.inlier = std::move(active);
  return result;
}

}  // namespace fastloop::optimization
