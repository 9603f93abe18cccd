#include "fastloop/optimization/pose_only.hpp"

#include <Eigen/Cholesky>

#include "fastloop/optimization/reprojection.hpp"

namespace fastloop::optimization {
namespace {

constexpr int kRounds = 4;
constexpr int kIterations = 10;
constexpr int kMinObservations = 3;
constexpr double kMinDamping = 1e-9;  ///< keeps directions that no observation constrains at rest
constexpr double kFirstDamping = 1e-4;
/// A round ends when a full step promises to lower the cost by less than this: the cost is a
/// chi-square, so the step is below 3 % of a standard deviation (0.1 % in the last round).
constexpr double kRoundDecrease = 1e-3;
constexpr double kLastRoundDecrease = 1e-6;

/// Levenberg-Marquardt on the active observations, starting as Gauss-Newton.
void refine(const StereoRig& rig, std::span<const PoseObservation> observations,
            std::span<const std::uint8_t> active, bool last_round, SE3* T_world_left) {
  const bool robust = !last_round;
  double damping = kMinDamping;
  ReprojectionTerms terms =
      accumulate_reprojection(rig, T_world_left->inverse(), observations, active, robust);
  for (int i = 0; i < kIterations; ++i) {
    Matrix6d h = terms.hessian;
    h.diagonal() *= 1.0 + damping;
    const Vector6d step = -h.ldlt().solve(terms.gradient);
    if (!step.allFinite()) return;
    const SE3 trial = T_world_left->retract(step);
    if (-step.dot(terms.gradient) < (last_round ? kLastRoundDecrease : kRoundDecrease)) {
      if (damping == kMinDamping) *T_world_left = trial;
      return;
    }
    const ReprojectionTerms next =
        accumulate_reprojection(rig, trial.inverse(), observations, active, robust);
    if (next.cost < terms.cost) {
      *T_world_left = trial;
      terms = next;
      damping = std::max(kMinDamping, 0.1 * damping);
    } else {
      damping = std::max(kFirstDamping, 10.0 * damping);
    }
  }
}

}  // namespace

PoseOnlyResult optimize_pose(const StereoRig& rig, const SE3& initial_T_world_body,
                             std::span<const PoseObservation> observations) {
  PoseOnlyResult result;
  result.T_world_body = initial_T_world_body;
  result.inlier.assign(observations.size(), 0);
  if (!initial_T_world_body.is_finite()) return result;

  SE3 T_world_left = initial_T_world_body * rig.T_body_left;
  const SE3 initial_T_left_world = T_world_left.inverse();
  std::vector<std::uint8_t> usable(observations.size());
  int num_seen = 0;
  for (std::size_t i = 0; i < observations.size(); ++i) {
    usable[i] = is_usable(rig, observations[i]);
    num_seen +=
        usable[i] && rig.left.is_projectable(initial_T_left_world * observations[i].p_world);
  }
  if (num_seen < kMinObservations) return result;

  std::vector<std::uint8_t> active = usable;
  int num_inliers = num_seen;
  for (int round = 0; round < kRounds && num_inliers >= kMinObservations; ++round) {
    refine(rig, observations, active, round == kRounds - 1, &T_world_left);
    num_inliers = classify_by_gate(rig, T_world_left.inverse(), observations, usable, 1.0, active);
  }
  if (num_inliers < kMinObservations || !T_world_left.is_finite()) return result;
  result.T_world_body = T_world_left * rig.T_body_left.inverse();
  result.inlier = std::move(active);
  result.num_inliers = num_inliers;
  return result;
}

}  // namespace fastloop::optimization
