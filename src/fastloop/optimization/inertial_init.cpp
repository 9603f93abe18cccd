#include "fastloop/optimization/inertial_init.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <optional>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/imu_factor.hpp"

namespace fastloop::optimization {
namespace {

using Vector9d = Eigen::Matrix<double, 9, 1>;
using Matrix9d = Eigen::Matrix<double, 9, 9>;

constexpr int kMinKeyframes = 3;
constexpr int kMaxIterations = 50;
constexpr int kPasses = 2;  ///< the second about the bias found by the first
constexpr double kConvergedDecrease = 1e-6;
constexpr double kMinDamping = 1e-10;
/// A body that neither turns nor accelerates by more than this cannot tell bias from gravity.
constexpr double kMinAcceleration = 0.05;  ///< m / s^2, root mean square about the mean
constexpr double kMinTurn = 0.05;          ///< rad, between any keyframe and the first
/// Gravity felt along the path has to be about that of the earth, else scale, units or clocks are
/// wrong.
constexpr double kMinGravity = 7.0, kMaxGravity = 13.0;
constexpr double kMaxGravityStddev = 0.1;  ///< rad

// Unknowns: gravity direction (2), log scale (1), gyro bias (3), accel bias (3), velocities (3
// each).
constexpr int kGravity = 0, kScale = 2, kGyroBias = 3, kAccelBias = 6, kVelocity = 9;

struct Estimate {
  Matrix3d R_world_gravity = Matrix3d::Identity();
  double log_scale = 0;
  ImuBias bias;
  std::vector<Vector3d> v_world;
};

struct NormalEquations {
  Eigen::MatrixXd hessian;
  Eigen::VectorXd gradient;
  double cost = 0;  ///< with the priors
  double chi2 = 0;  ///< of the measurements alone
};

class InertialInitializer {
 public:
  explicit InertialInitializer(const InertialInitProblem& problem);

  InertialInitResult run();

 private:
  int size() const { return kVelocity + 3 * static_cast<int>(poses_.size()); }
  std::optional<std::string> start();
  void integrate_about(const ImuBias& bias);
  bool is_excited() const;
  NormalEquations linearize(const Estimate& x) const;
  void add_interval(const Estimate& x, std::size_t i, NormalEquations* sum) const;
  void add_bias_prior(const Estimate& x, NormalEquations* sum) const;
  Estimate moved(const Estimate& x, const Eigen::VectorXd& d) const;
  bool solve();
  void measure_spread(InertialInitResult* result) const;

  const InertialInitProblem& problem_;
  const std::vector<SE3>& poses_;
  std::vector<PreintegratedImu> imu_;
  std::vector<Matrix9d> sqrt_information_;
  Estimate x_;
};

InertialInitializer::InertialInitializer(const InertialInitProblem& problem)
    : problem_(problem), poses_(problem.T_world_body) {
  const std::size_t n = poses_.size();
  if (n > 0 && problem.between.size() != n - 1)
    throw InvalidArgument("initialize_inertial: one IMU interval between every two keyframes");
  if (!problem.v_world.empty() && problem.v_world.size() != n)
    throw InvalidArgument("initialize_inertial: as many velocities as keyframes, or none");
  for (const auto& imu : problem.between)
    if (!imu) throw InvalidArgument("initialize_inertial: an IMU interval is missing");
}

/// Error covariance of each interval: that of the IMU plus that of the two poses from vision.
void InertialInitializer::integrate_about(const ImuBias& bias) {
  std::vector<PreintegratedImu> imu;
  sqrt_information_.clear();
  const double rotation_variance = problem_.rotation_stddev_rad * problem_.rotation_stddev_rad;
  const double position_variance = problem_.position_stddev_m * problem_.position_stddev_m;
  for (std::size_t i = 0; i + 1 < poses_.size(); ++i) {
    imu.push_back(problem_.between[i]->rebased(bias));
    const Matrix3d R_turn = imu[i].delta_rotation(bias).toRotationMatrix();
    Eigen::Matrix<double, 9, 3> d_from;  // by the rotation of the first pose
    d_from << -R_turn.transpose(), so3::hat(imu[i].delta_velocity(bias)),
        so3::hat(imu[i].delta_position(bias));
    Matrix9d covariance = imu[i].covariance() + rotation_variance * d_from * d_from.transpose();
    covariance.diagonal().head<3>().array() += rotation_variance;
    covariance.diagonal().tail<3>().array() += 2 * position_variance;
    sqrt_information_.push_back(sqrt_information_of(covariance));
  }
  imu_ = std::move(imu);
}

/// Start values; the reason when there are none.
std::optional<std::string> InertialInitializer::start() {
  const std::size_t n = poses_.size();
  if (n < kMinKeyframes) return "too few keyframes";
  for (const SE3& T : poses_)
    if (!T.is_finite()) return "a keyframe pose is not finite";
  if (!problem_.bias.gyro.allFinite() || !problem_.bias.accel.allFinite() ||
      !problem_.R_world_gravity.allFinite())
    return "a start value is not finite";
  x_.bias = problem_.bias;
  x_.v_world = problem_.v_world;
  integrate_about(x_.bias);
  if (x_.v_world.empty()) {
    for (std::size_t i = 0; i < n; ++i) {
      const std::size_t a = i == 0 ? 0 : i - 1, b = std::min(i + 1, n - 1);
      double dt = 0;
      for (std::size_t k = a; k < b; ++k) dt += imu_[k].duration_s();
      x_.v_world.push_back((poses_[b].translation - poses_[a].translation) / dt);
    }
  }
  for (const Vector3d& v : x_.v_world)
    if (!v.allFinite()) return "a start value is not finite";
  x_.R_world_gravity = problem_.R_world_gravity;
  if (!problem_.guess_gravity) return std::nullopt;

  Vector3d gravity = x_.v_world.back() - x_.v_world.front();
  double duration = 0;
  for (std::size_t i = 0; i + 1 < n; ++i) {
    gravity -= poses_[i].rotation * imu_[i].delta_velocity(x_.bias);
    duration += imu_[i].duration_s();
  }
  const double strength = gravity.norm() / duration;
  if (!problem_.estimate_scale && (strength < kMinGravity || strength > kMaxGravity))
    return "the measured gravity does not fit the motion";
  x_.R_world_gravity =
      Eigen::Quaterniond::FromTwoVectors(kGravityWorld, gravity).toRotationMatrix();
  return std::nullopt;
}

bool InertialInitializer::is_excited() const {
  std::vector<Vector3d> accelerations;
  Vector3d mean = Vector3d::Zero();
  double turn = 0;
  for (std::size_t i = 0; i < imu_.size(); ++i) {
    accelerations.push_back(poses_[i].rotation * imu_[i].delta_velocity(x_.bias) /
                            imu_[i].duration_s());
    mean += accelerations.back() / static_cast<double>(imu_.size());
    turn = std::max(turn, angle_between(poses_[0], poses_[i + 1]));
  }
  double variance = 0;
  for (const Vector3d& a : accelerations)
    variance += (a - mean).squaredNorm() / static_cast<double>(imu_.size());
  const bool accelerates = std::sqrt(variance) >= kMinAcceleration;
  return accelerates || (!problem_.estimate_scale && turn >= kMinTurn);
}

void InertialInitializer::add_interval(const Estimate& x, std::size_t i,
                                       NormalEquations* sum) const {
  const PreintegratedImu& imu = imu_[i];
  const double dt = imu.duration_s();
  const Matrix3d R_inv = poses_[i].rotation.toRotationMatrix().transpose();
  const Vector3d gravity = x.R_world_gravity * kGravityWorld;
  const Vector3d moved =
      std::exp(x.log_scale) * (poses_[i + 1].translation - poses_[i].translation);
  const Vector3d rotation_error =
      so3::log(imu.delta_rotation(x.bias).conjugate() *
               (poses_[i].rotation.conjugate() * poses_[i + 1].rotation));
  Vector9d r;
  r << rotation_error,
      R_inv * (x.v_world[i + 1] - x.v_world[i] - dt * gravity) - imu.delta_velocity(x.bias),
      R_inv * (moved - dt * x.v_world[i] - 0.5 * dt * dt * gravity) - imu.delta_position(x.bias);

  Eigen::Matrix<double, 9, 15> j =
      Eigen::Matrix<double, 9, 15>::Zero();  // velocities i, i + 1 last
  const Eigen::Matrix<double, 3, 2> d_gravity =
      -(x.R_world_gravity * so3::hat(kGravityWorld)).leftCols<2>();
  j.block<3, 2>(3, kGravity) = -dt * R_inv * d_gravity;
  j.block<3, 2>(6, kGravity) = -0.5 * dt * dt * R_inv * d_gravity;
  if (problem_.estimate_scale) j.block<3, 1>(6, kScale) = R_inv * moved;
  const Matrix3d& d_turn = imu.d_rotation_d_gyro_bias();
  j.block<3, 3>(0, kGyroBias) = -so3::right_jacobian_inverse(rotation_error) *
                                so3::exp(rotation_error).toRotationMatrix().transpose() *
                                so3::right_jacobian(d_turn * (x.bias.gyro - imu.bias().gyro)) *
                                d_turn;
  j.block<3, 3>(3, kGyroBias) = -imu.d_velocity_d_gyro_bias();
  j.block<3, 3>(6, kGyroBias) = -imu.d_position_d_gyro_bias();
  j.block<3, 3>(3, kAccelBias) = -imu.d_velocity_d_accel_bias();
  j.block<3, 3>(6, kAccelBias) = -imu.d_position_d_accel_bias();
  j.block<3, 3>(3, kVelocity) = -R_inv;
  j.block<3, 3>(6, kVelocity) = -dt * R_inv;
  j.block<3, 3>(3, kVelocity + 3) = R_inv;

  r = (sqrt_information_[i] * r).eval();
  j = (sqrt_information_[i] * j).eval();
  const Eigen::Matrix<double, 15, 15> h = j.transpose() * j;
  const Eigen::Matrix<double, 15, 1> g = j.transpose() * r;
  const int v = kVelocity + 3 * static_cast<int>(i);
  sum->hessian.topLeftCorner<9, 9>() += h.topLeftCorner<9, 9>();
  sum->hessian.block<9, 6>(0, v) += h.topRightCorner<9, 6>();
  sum->hessian.block<6, 9>(v, 0) += h.bottomLeftCorner<6, 9>();
  sum->hessian.block<6, 6>(v, v) += h.bottomRightCorner<6, 6>();
  sum->gradient.head<9>() += g.head<9>();
  sum->gradient.segment<6>(v) += g.tail<6>();
  sum->chi2 += r.squaredNorm();
}

void InertialInitializer::add_bias_prior(const Estimate& x, NormalEquations* sum) const {
  const double gyro = problem_.gyro_prior_information, accel = problem_.accel_prior_information;
  sum->hessian.diagonal().segment<3>(kGyroBias).array() += gyro;
  sum->hessian.diagonal().segment<3>(kAccelBias).array() += accel;
  sum->gradient.segment<3>(kGyroBias) += gyro * x.bias.gyro;
  sum->gradient.segment<3>(kAccelBias) += accel * x.bias.accel;
  sum->cost = sum->chi2 + gyro * x.bias.gyro.squaredNorm() + accel * x.bias.accel.squaredNorm();
}

NormalEquations InertialInitializer::linearize(const Estimate& x) const {
  NormalEquations sum;
  sum.hessian.setZero(size(), size());
  sum.gradient.setZero(size());
  for (std::size_t i = 0; i + 1 < poses_.size(); ++i) add_interval(x, i, &sum);
  if (!problem_.estimate_scale) sum.hessian(kScale, kScale) = 1;
  add_bias_prior(x, &sum);
  return sum;
}

Estimate InertialInitializer::moved(const Estimate& x, const Eigen::VectorXd& d) const {
  Estimate y = x;
  y.R_world_gravity =
      (Eigen::Quaterniond(x.R_world_gravity) * so3::exp({d(kGravity), d(kGravity + 1), 0}))
          .normalized()
          .toRotationMatrix();
  y.log_scale += d(kScale);
  y.bias.gyro += d.segment<3>(kGyroBias);
  y.bias.accel += d.segment<3>(kAccelBias);
  for (std::size_t i = 0; i < y.v_world.size(); ++i)
    y.v_world[i] += d.segment<3>(kVelocity + 3 * static_cast<int>(i));
  return y;
}

/// True when converged.
bool InertialInitializer::solve() {
  double damping = kMinDamping;
  NormalEquations equations = linearize(x_);
  for (int i = 0; i < kMaxIterations; ++i) {
    Eigen::MatrixXd h = equations.hessian;
    h.diagonal() *= 1.0 + damping;
    const Eigen::VectorXd step = -h.ldlt().solve(equations.gradient);
    if (!step.allFinite()) return false;
    const Estimate trial = moved(x_, step);
    if (-step.dot(equations.gradient) < kConvergedDecrease) {
      if (damping > 1e-3) return false;  // only short steps are left to take
      x_ = trial;
      return true;
    }
    NormalEquations next = linearize(trial);
    if (next.cost < equations.cost) {
      x_ = trial;
      equations = std::move(next);
      damping = std::max(kMinDamping, 0.1 * damping);
    } else {
      damping = std::max(1e-5, 10.0 * damping);
    }
  }
  return false;
}

/// Standard deviations from the inverse Hessian, widened by the residuals where these exceed the
/// model.
void InertialInitializer::measure_spread(InertialInitResult* result) const {
  const NormalEquations equations = linearize(x_);
  Eigen::MatrixXd selected = Eigen::MatrixXd::Zero(size(), kVelocity);
  selected.topRows(kVelocity).setIdentity();
  const Eigen::MatrixXd covariance = equations.hessian.ldlt().solve(selected).topRows(kVelocity);
  const double dof = std::max(1.0, 9.0 * static_cast<double>(imu_.size()) - size());
  const double widening = std::sqrt(std::max(1.0, equations.chi2 / dof));
  const auto stddev = [&](const auto& block) {
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen{Eigen::MatrixXd(block)};
    return widening * std::sqrt(std::max(0.0, eigen.eigenvalues().maxCoeff()));
  };
  result->gravity_stddev_rad = stddev(covariance.block<2, 2>(kGravity, kGravity));
  result->accel_bias_stddev = stddev(covariance.block<3, 3>(kAccelBias, kAccelBias));
}

InertialInitResult InertialInitializer::run() {
  InertialInitResult result;
  result.v_world = problem_.v_world;
  const auto failed = [&](const std::string& reason) {
    result.success = false;
    result.reason = reason;
    return result;
  };
  if (const auto reason = start()) return failed(*reason);
  if (!is_excited()) return failed("too little motion");
  for (int pass = 0; pass < kPasses; ++pass) {
    if (!solve()) return failed("did not converge");
    integrate_about(x_.bias);
  }
  measure_spread(&result);
  result.R_world_gravity = x_.R_world_gravity;
  result.scale = std::exp(x_.log_scale);
  result.bias = x_.bias;
  result.v_world = x_.v_world;
  if (!std::isfinite(result.scale + result.gravity_stddev_rad + result.accel_bias_stddev))
    return failed("result is not finite");
  if (result.gravity_stddev_rad > kMaxGravityStddev)
    return failed("the direction of gravity is uncertain");
  result.success = true;
  return result;
}

}  // namespace

InertialInitResult initialize_inertial(const InertialInitProblem& problem) {
  return InertialInitializer(problem).run();
}

}  // namespace fastloop::optimization
