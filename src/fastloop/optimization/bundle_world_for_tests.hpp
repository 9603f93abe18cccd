#pragma once

#include "fastloop/optimization/bundle_adjustment.hpp"
#include "fastloop/optimization/synthetic_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::optimization::synthetic {

/// Bundle problem along fastloop::synthetic::Motion with its truth.
struct BundleWorld {
  BundleProblem truth;    ///< exact states, noisy measurements
  BundleProblem problem;  ///< the same measurements, disturbed states
};

struct BundleWorldOptions {
  int poses = 12;
  int fixed_poses = 2;
  int points = 400;
  int max_observations_of_point = 1000;
  double sigma_px = 0.7;
  double stereo_fraction = 0.8;
  double outlier_fraction = 0;
  bool inertial = false;
  Nanoseconds step_ns = 250'000'000;
  ImuBias bias{{0.004, -0.003, 0.002}, {0.03, 0.05, -0.04}};
};

inline void observe_all(const BundleWorldOptions& options, BundleProblem& p, std::mt19937& rng) {
  std::uniform_real_distribution<double> u(0, 1);
  std::vector<int> seen(p.points.size(), 0);
  for (std::size_t i = 0; i < p.poses.size(); ++i) {
    const SE3 T_left_world = (p.poses[i].state.T_world_body * p.rig.T_body_left).inverse();
    for (std::size_t k = 0; k < p.points.size(); ++k) {
      const Vector3d p_left = T_left_world * p.points[k];
      if (seen[k] >= options.max_observations_of_point || p_left.norm() < 0.5) continue;
      auto z = observe(p.rig, p_left, options.sigma_px, u(rng) < options.stereo_fraction, rng);
      if (!z) continue;
      if (u(rng) < options.outlier_fraction)
        z->left += Eigen::Vector2d(u(rng) < 0.5 ? 40 : -40, 60 * u(rng) - 30);
      ++seen[k];
      const double sigma = options.sigma_px > 0 ? options.sigma_px : 1;
      p.observations.push_back({static_cast<int>(i), static_cast<int>(k), *z, 1 / (sigma * sigma)});
    }
  }
}

inline BundleWorld make_bundle_world(const StereoRig& rig, const BundleWorldOptions& options,
                                     unsigned seed) {
  std::mt19937 rng(seed);
  BundleWorld world;
  BundleProblem& truth = world.truth;
  truth.rig = rig;
  for (int i = 0; i < options.poses; ++i) {
    BundlePose pose;
    pose.state = fastloop::synthetic::Motion::state(i * options.step_ns);
    pose.state.bias = options.bias;
    pose.pose_fixed = i < options.fixed_poses;
    truth.poses.push_back(pose);
  }
  for (int i = 0; i < options.points; ++i) {
    std::uniform_real_distribution<double> distance(4, 9);
    truth.points.push_back(distance(rng) * normal_vector(rng, 1).normalized());
  }
  observe_all(options, truth, rng);
  if (options.inertial) {
    const ImuCalibration noise;
    auto samples =
        fastloop::synthetic::regular_samples(0, options.poses * options.step_ns, 5'000'000);
    fastloop::synthetic::disturb(samples, options.bias, noise, rng);
    for (int i = 0; i + 1 < options.poses; ++i)
      truth.imu_edges.push_back(
          {i, i + 1,
           std::make_shared<PreintegratedImu>(samples, i * options.step_ns,
                                              (i + 1) * options.step_ns, ImuBias{}, noise)});
  }
  world.problem = truth;
  for (BundlePose& p : world.problem.poses) {
    if (!p.pose_fixed) p.state.T_world_body = p.state.T_world_body * random_pose(rng, 0.005, 0.02);
    p.state.v_world += normal_vector(rng, 0.1);
    p.state.bias = {};
  }
  for (Vector3d& p : world.problem.points) p += normal_vector(rng, 0.05);
  return world;
}

}  // namespace fastloop::optimization::synthetic
