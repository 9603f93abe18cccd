#pragma once

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "fastloop/sensor/imu.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop::optimization {

struct BundlePose {
  NavState state;  ///< velocity and bias are used only where IMU edges touch the pose
  bool pose_fixed = false;
  bool motion_fixed = false;  ///< velocity and bias fixed
};

struct BundleObservation {
  int pose = 0, point = 0;  ///< indices
  PixelObservation pixel;
  double inv_sigma2 = 1;
};

/// Consecutive poses joined by preintegrated IMU measurements and bias random walk.
struct BundleImuEdge {
  int from = 0, to = 0;
  std::shared_ptr<const PreintegratedImu> imu;
};

/// Flat bundle adjustment problem; visual-only when imu_edges is empty. Knows no map.
struct BundleProblem {
  StereoRig rig;
  std::vector<BundlePose> poses;
  std::vector<Vector3d> points;  ///< world, metres
  std::vector<BundleObservation> observations;
  std::vector<BundleImuEdge> imu_edges;
};

/// How the reduced system of the poses is solved. kAuto: dense for local problems, sparse Cholesky
/// above, conjugate gradients for very many poses.
enum class BundleSolver : int { kAuto, kDense, kSparse, kIterative };

struct BundleOptions {
  int iterations = 5;  ///< first pass, with Huber kernel
  int iterations_after_gate =
      5;                   ///< second pass after outliers (chi2_gate) were taken out; 0 = none
  bool robust = true;      ///< Huber kernel at sqrt(chi2_gate) in both passes
  double max_seconds = 0;  ///< wall clock budget, 0 = none (never used in deterministic runs)
  int threads = 1;
  BundleSolver solver = BundleSolver::kAuto;
  const std::atomic<bool>* cancel =
      nullptr;  ///< checked every iteration; the best state so far is kept
  void validate() const;
};

struct BundleResult {
  bool usable = false;  ///< finite and cost not higher than at the start; else problem is unchanged
  bool cancelled = false;
  std::string reason;                       ///< why not usable
  double initial_cost = 0, final_cost = 0;  ///< robust cost over the observations kept
  int iterations = 0;
  std::vector<std::uint8_t>
      outlier;  ///< [observations] failed chi2_gate (or behind the camera) at the end
};

/// Optimises poses, points (and velocities, biases) in place with Ceres and analytic derivatives.
///
/// Gauge: when no pose is fixed, the first one used is held; with IMU edges only its position and
/// heading are, for its roll and pitch must follow gravity.
/// Observations with non-finite numbers or of non-finite points are left out and reported as
/// outliers; a non-finite pose makes the result unusable.
/// The result is the same for the same input and one thread.
/// @throws InvalidArgument on indices out of range
BundleResult adjust_bundle(BundleProblem& problem, const BundleOptions& options = {});

}  // namespace fastloop::optimization
