#include "fastloop/sim/trajectory.hpp"

#include <Eigen/SparseCholesky>
#include <algorithm>
#include <array>
#include <cmath>

#include "fastloop/core/error.hpp"

namespace fastloop::sim {
namespace {

constexpr int kOrder = 6;
using Weights = std::array<double, kOrder>;

/// Uniform quintic B-spline: coefficient of u^column in the weight of control point `row`, times 120.
constexpr double kBasis[kOrder][kOrder] = {
    {1, -5, 10, -10, 5, -1},  {26, -50, 20, 20, -20, 5}, {66, 0, -60, 0, 30, -10},
    {26, 50, 20, -20, -20, 10}, {1, 5, 10, 10, 5, -5},    {0, 0, 0, 0, 0, 1},
};

/// Weights of the six control points, or their derivatives by u.
Weights weights(double u, int derivative) {
  Weights w{};
  for (int i = 0; i < kOrder; ++i) {
    double value = 0;
    for (int p = kOrder - 1; p >= derivative; --p) {
      double factor = kBasis[i][p] / 120.0;
      for (int d = 0; d < derivative; ++d) factor *= p - d;
      value = value * u + factor;
    }
    w[i] = value;
  }
  return w;
}

/// Weights of the increments between control points: sums from the far end.
Weights cumulative(Weights w) {
  for (int i = kOrder - 2; i >= 0; --i) w[i] += w[i + 1];
  return w;
}

using Sparse = Eigen::SparseMatrix<double>;

/// Basis matrix, one row per sample.
Sparse basis_matrix(std::span<const double> times_s, double begin_s, double knot_s, int controls) {
  std::vector<Eigen::Triplet<double>> entries;
  for (std::size_t row = 0; row < times_s.size(); ++row) {
    const double x = std::max(0.0, (times_s[row] - begin_s) / knot_s);
    const int first = std::min(static_cast<int>(x), controls - kOrder);
    const Weights w = weights(x - first, 0);
    for (int i = 0; i < kOrder; ++i)
      entries.emplace_back(static_cast<int>(row), first + i, w[i]);
  }
  Sparse basis(static_cast<int>(times_s.size()), controls);
  basis.setFromTriplets(entries.begin(), entries.end());
  return basis;
}

/// Third differences of the control points: keeps gaps in the record and the ends well-behaved.
Sparse smoothness_matrix(int controls) {
  std::vector<Eigen::Triplet<double>> entries;
  for (int row = 0; row + 3 < controls; ++row) {
    constexpr double kDifference[4] = {-1, 3, -3, 1};
    for (int i = 0; i < 4; ++i) entries.emplace_back(row, row + i, kDifference[i]);
  }
  Sparse smoothness(controls - 3, controls);
  smoothness.setFromTriplets(entries.begin(), entries.end());
  return smoothness;
}

std::vector<SE3> nearest_poses(std::span<const double> times_s, std::span<const SE3> poses,
                               double begin_s, double knot_s, int controls) {
  std::vector<SE3> control(controls);
  for (int j = 0; j < controls; ++j) {
    const double t = begin_s + (j - 2) * knot_s;
    const auto it = std::lower_bound(times_s.begin(), times_s.end(), t);
    const std::size_t i = std::min<std::size_t>(it - times_s.begin(), times_s.size() - 1);
    control[j] = poses[i];
  }
  return control;
}

}  // namespace

Trajectory::Trajectory(double begin_s, double knot_s, std::vector<SE3> control)
    : begin_s_(begin_s), knot_s_(knot_s), control_(std::move(control)) {
  if (control_.size() < kOrder) throw InvalidArgument("a trajectory needs at least 6 control poses");
  if (!(knot_s > 0)) throw InvalidArgument("knot spacing must be positive");
}

Trajectory Trajectory::fit(std::span<const double> times_s, std::span<const SE3> T_world_body,
                           double knot_s) {
  if (times_s.size() < 2 || times_s.size() != T_world_body.size())
    throw InvalidArgument("a recorded motion needs at least 2 poses with their times");
  for (std::size_t i = 1; i < times_s.size(); ++i)
    if (!(times_s[i] > times_s[i - 1])) throw InvalidArgument("times of a motion must increase");
  const double begin_s = times_s.front(), span_s = times_s.back() - begin_s;
  const int controls = static_cast<int>(std::ceil(span_s / knot_s)) + kOrder;
  Trajectory trajectory(begin_s, knot_s,
                        nearest_poses(times_s, T_world_body, begin_s, knot_s, controls));

  const Sparse basis = basis_matrix(times_s, begin_s, knot_s, controls);
  const Sparse smoothness = smoothness_matrix(controls);
  const Sparse normal = Sparse(basis.transpose() * basis) +
                        1e-5 * Sparse(smoothness.transpose() * smoothness);
  const Eigen::SimplicialLDLT<Sparse> solver(normal);

  // Positions are linear. A small rotation of the control poses acts on the spline through (nearly) the
  // same weights, so the rotations need a few rounds with the same matrix.
  const auto n = static_cast<Eigen::Index>(times_s.size());
  for (int round = 0; round < 12; ++round) {
    Eigen::MatrixXd residual(n, 6);
    for (Eigen::Index i = 0; i < n; ++i) {
      const SE3 now = trajectory.pose(times_s[i]);
      residual.row(i).head<3>() =
          so3::log(now.rotation.conjugate() * T_world_body[i].rotation).transpose();
      residual.row(i).tail<3>() = (T_world_body[i].translation - now.translation).transpose();
    }
    const Eigen::MatrixXd step = solver.solve(Eigen::MatrixXd(basis.transpose() * residual));
    for (int j = 0; j < controls; ++j) {
      SE3& c = trajectory.control_[j];
      c.rotation = (c.rotation * so3::exp(step.row(j).head<3>())).normalized();
      c.translation += step.row(j).tail<3>().transpose();
    }
    if (step.cwiseAbs().maxCoeff() < 1e-9) break;
  }
  return trajectory;
}

double Trajectory::end_s() const {
  return begin_s_ + knot_s_ * static_cast<double>(control_.size() - kOrder + 1);
}

Trajectory::Segment Trajectory::segment(double t_s) const {
  const double last = static_cast<double>(control_.size() - kOrder);
  const double x = std::clamp((t_s - begin_s_) / knot_s_, 0.0, last + 1.0);
  const double first = std::min(std::floor(x), last);
  return {static_cast<std::size_t>(first), x - first};
}

Vector3d Trajectory::blend(double t_s, int derivative) const {
  const Segment s = segment(t_s);
  const Weights w = weights(s.u, derivative);
  // Relative to the first control point: keeps the digits of small motions far from the origin.
  const Vector3d origin = control_[s.first].translation;
  Vector3d sum = Vector3d::Zero();
  for (int i = 1; i < kOrder; ++i) sum += w[i] * (control_[s.first + i].translation - origin);
  if (derivative == 0) return origin + sum;
  return sum / std::pow(knot_s_, derivative);
}

SE3 Trajectory::pose(double t_s) const {
  const Segment s = segment(t_s);
  const Weights w = cumulative(weights(s.u, 0));
  Eigen::Quaterniond q = control_[s.first].rotation;
  for (int i = 1; i < kOrder; ++i) {
    const Vector3d d = so3::log(control_[s.first + i - 1].rotation.conjugate() *
                                control_[s.first + i].rotation);
    q = q * so3::exp(w[i] * d);
  }
  return SE3(q, blend(t_s, 0));
}

Vector3d Trajectory::velocity(double t_s) const { return blend(t_s, 1); }

Vector3d Trajectory::acceleration(double t_s) const { return blend(t_s, 2); }

Vector3d Trajectory::angular_velocity(double t_s) const {
  const Segment s = segment(t_s);
  const Weights w = cumulative(weights(s.u, 0)), rate = cumulative(weights(s.u, 1));
  Vector3d omega = Vector3d::Zero();
  for (int i = 1; i < kOrder; ++i) {
    const Vector3d d = so3::log(control_[s.first + i - 1].rotation.conjugate() *
                                control_[s.first + i].rotation);
    omega = so3::exp(-w[i] * d) * omega + rate[i] / knot_s_ * d;
  }
  return omega;
}

}  // namespace fastloop::sim
