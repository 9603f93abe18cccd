#include <benchmark/benchmark.h>

#include "fastloop/optimization/bundle_world_for_tests.hpp"

namespace fastloop::optimization {
namespace {

using namespace synthetic;

StereoRig rig_of(int64_t kind) {
  return kind == 0 ? rectified_rig() : fisheye_rig();
}

/// Args: rig (0 rectified, 1 fisheye), observations; a tenth of them outliers, start 1 degree and 5
/// cm off.
void bench_optimize_pose(benchmark::State& state) {
  std::mt19937 rng(1);
  const StereoRig rig = rig_of(state.range(0));
  const SE3 truth = random_pose(rng, 1, 3);
  auto obs = observations(rig, truth, static_cast<int>(state.range(1)), 1.0, rng);
  add_outliers(obs, 0.1, rng);
  const SE3 start = truth * random_pose(rng, 0.01, 0.03);
  for (auto _ : state) benchmark::DoNotOptimize(optimize_pose(rig, start, obs).num_inliers);
}
BENCHMARK(bench_optimize_pose)
    ->ArgsProduct({{0, 1}, {300, 500, 1000}})
    ->Unit(benchmark::kMicrosecond);

/// Args: rig, observations. One frame of 50 ms with the marginal prior of the frame before.
void bench_optimize_pose_inertial(benchmark::State& state) {
  using fastloop::synthetic::Motion;
  std::mt19937 rng(2);
  const StereoRig rig = rig_of(state.range(0));
  const ImuCalibration noise;
  auto samples = fastloop::synthetic::regular_samples(0, 50'000'000, 5'000'000);
  fastloop::synthetic::disturb(samples, {}, noise, rng);
  const PreintegratedImu imu(samples, 0, 50'000'000, {}, noise);
  const SE3 truth = Motion::state(50'000'000).T_world_body;
  auto obs = observations(rig, truth, static_cast<int>(state.range(1)), 1.0, rng);
  add_outliers(obs, 0.1, rng);
  NavPrior prior;
  prior.mean = Motion::state(0);
  prior.mean.T_world_body = prior.mean.T_world_body * random_pose(rng, 0.001, 0.004);
  Eigen::Matrix<double, 15, 1> stddev;
  stddev << Vector3d::Constant(0.002), Vector3d::Constant(0.005), Vector3d::Constant(0.02),
      Vector3d::Constant(5e-4), Vector3d::Constant(0.01);
  prior.information = stddev.cwiseAbs2().cwiseInverse().asDiagonal();
  const InertialPoseProblem problem{&rig, obs, prior.mean, &imu, prior, imu.predict(prior.mean)};
  for (auto _ : state) benchmark::DoNotOptimize(optimize_pose_inertial(problem).num_inliers);
}
BENCHMARK(bench_optimize_pose_inertial)
    ->ArgsProduct({{0, 1}, {300, 500}})
    ->Unit(benchmark::kMicrosecond);

/// Local problem: 20 free and 20 fixed poses, 3,000 points, about 15,000 observations, 5 + 5
/// iterations. Args: rig, inertial, percent of the observations with a right part.
void bench_adjust_bundle(benchmark::State& state) {
  const BundleWorld world =
      make_bundle_world(rig_of(state.range(0)),
                        {.poses = 40,
                         .fixed_poses = 20,
                         .points = 3000,
                         .max_observations_of_point = 1000,
                         .stereo_fraction = static_cast<double>(state.range(2)) / 100,
                         .outlier_fraction = 0.02,
                         .inertial = state.range(1) != 0},
                        7);
  BundleWorld reduced = world;
  // Thin the observations out evenly to the size of a real local problem.
  const std::size_t keep = world.problem.observations.size() / 15000 + 1;
  std::erase_if(reduced.problem.observations, [&, i = std::size_t{0}](const auto&) mutable {
    return (i++ * 2654435761u >> 7) % keep != 0;
  });
  double final_cost = 0, iterations = 0;
  for (auto _ : state) {
    state.PauseTiming();
    BundleProblem problem = reduced.problem;
    state.ResumeTiming();
    const BundleResult result = adjust_bundle(problem);
    final_cost = result.final_cost;
    iterations = result.iterations;
  }
  state.counters["observations"] = static_cast<double>(reduced.problem.observations.size());
  state.counters["final_cost"] = final_cost;
  state.counters["iterations"] = iterations;
}
BENCHMARK(bench_adjust_bundle)
    ->ArgsProduct({{0, 1}, {0, 1}, {80, 100}})
    ->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace fastloop::optimization
