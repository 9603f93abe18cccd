// The searches of matching/, reference against cpu on the same input. The counter "ratio" is the
// time of the reference over that of the parallel back end, both measured alternately, medians.
// Limit the threads with `taskset -c 0` for the figures of one core.
#include <benchmark/benchmark.h>

#include <algorithm>

#include "fastloop/core/time.hpp"
#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

double median(std::vector<double> v) {
  std::nth_element(v.begin(), v.begin() + static_cast<long>(v.size() / 2), v.end());
  return v[v.size() / 2];
}

/// Times body(executor) with both executors in turn; the benchmark's own time is that of the
/// parallel one.
template <class Body>
void compare(benchmark::State& state, const Body& body) {
  std::vector<double> reference_ms, cpu_ms;
  for (auto _ : state) {
    Stopwatch watch;
    body(Executor::reference());
    reference_ms.push_back(watch.elapsed_ms());
    watch.restart();
    body(Executor::cpu());
    cpu_ms.push_back(watch.elapsed_ms());
    state.SetIterationTime(cpu_ms.back() / 1000);
  }
  state.counters["cpu_ms"] = median(cpu_ms);
  state.counters["ratio"] = median(reference_ms) / median(cpu_ms);
}

testing::Scene scene(benchmark::State& state, bool fisheye) {
  testing::SceneSize size;
  size.landmarks = static_cast<int>(state.range(0));
  size.targets = static_cast<int>(state.range(1));
  size.clutter = 800;
  return testing::random_scene(1, fisheye, size);
}

void projection_search(benchmark::State& state, bool fisheye, float radius_px) {
  const testing::Scene s = scene(state, fisheye);
  const auto targets = s.targets();
  std::vector<ProjectionMatches> results(targets.size());
  ProjectionSearchOptions options;
  options.radius_px = radius_px;
  compare(state, [&](const Executor& executor) {
    search_by_projection(executor, s.rig, s.scales, targets, s.landmarks.view(), options, results);
  });
}
BENCHMARK_CAPTURE(projection_search, pinhole_r3, false, 3.0f)
    ->Args({1000, 1})
    ->Args({5000, 1})
    ->Args({5000, 60})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(projection_search, pinhole_r8, false, 8.0f)
    ->Args({5000, 60})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(projection_search, fisheye_r3, true, 3.0f)
    ->Args({5000, 60})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

/// The search in the last frame: a window of 15 pixels about every keypoint.
void window_search(benchmark::State& state) {
  const testing::Scene s = scene(state, false);
  const FeatureSet& f = s.features[0];
  std::vector<WindowQuery> queries;
  for (std::size_t i = 0; i < f.size(); ++i)
    queries.push_back({{f.x[i] + 3, f.y[i] - 2}, NAN, 15, 0, 7, f.descriptors[i], f.angle_rad[i]});
  compare(state, [&](const Executor& executor) {
    benchmark::DoNotOptimize(search_windows(executor, f, queries, {}));
  });
}
BENCHMARK(window_search)->Args({5000, 1})->UseManualTime()->Unit(benchmark::kMillisecond);

void all_descriptors(benchmark::State& state) {
  const testing::Scene s = scene(state, false);
  const MatchSide first{&s.features[0], nullptr, {}}, second{&s.features[1], nullptr, {}};
  compare(state, [&](const Executor& executor) {
    benchmark::DoNotOptimize(match_descriptors(executor, first, second));
  });
}
BENCHMARK(all_descriptors)->Args({3000, 2})->UseManualTime()->Unit(benchmark::kMillisecond);

void triangulation(benchmark::State& state) {
  const testing::Scene s = scene(state, false);
  const Bearings a = compute_bearings(s.rig.left, s.features[0]);
  const Bearings b = compute_bearings(s.rig.left, s.features[1]);
  const TriangulationSide first{{&s.features[0], nullptr, {}}, s.T_camera_world[0], &a};
  const TriangulationSide second{{&s.features[1], nullptr, {}}, s.T_camera_world[1], &b};
  compare(state, [&](const Executor& executor) {
    benchmark::DoNotOptimize(search_for_triangulation(executor, s.rig, s.scales, first, second));
  });
}
BENCHMARK(triangulation)->Args({3000, 2})->UseManualTime()->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace fastloop::matching
