#include <benchmark/benchmark.h>

#include "fastloop/loop/loop_replay.hpp"
#include "fastloop/sim/map_worlds.hpp"

/// Whole loop closing without graph optimisation (detection, correction, applying) on simulated
/// maps, the published sequential way over ours. Both are repeated in turn in one run; pin the
/// program to the cores it may use, with taskset say.
namespace {

using namespace fastloop;

void loop_closing(benchmark::State& state, bool fisheye) {
  sim::MapWorldOptions world;
  world.keyframes = static_cast<int>(state.range(0));
  world.fisheye = fisheye;
  const sim::SimulatedMap simulated = sim::simulate_map(world);
  loop::LoopRequest request;
  request.keyframe = simulated.current;
  const auto snapshot = simulated.map.publish();
  std::vector<loop::LoopReplay> replays;
  for (const loop::Backend b : {loop::Backend::kReference, loop::Backend::kCpu})
    replays.emplace_back(snapshot, request, b);
  std::vector<loop::ReplaySummary> s;
  for (auto _ : state) s = loop::repeat_replays(replays, 21);
  if (!s[1].last.applied.applied ||
      decision_digest(s[0].last.outcome) != decision_digest(s[1].last.outcome)) {
    state.SkipWithError("the back ends decide differently, or the loop is not closed");
    return;
  }
  state.counters["reference_ms"] = s[0].total_without_graph_ms;
  state.counters["cpu_ms"] = s[1].total_without_graph_ms;
  state.counters["ratio"] = s[0].total_without_graph_ms / s[1].total_without_graph_ms;
  state.counters["ratio_with_graph"] = s[0].total_ms / s[1].total_ms;
  double covisibility_ms = 0;
  for (const auto& [stage, ms] : s[1].stages_ms)
    if (stage == "connections" || stage == "apply_covisibility") covisibility_ms += ms;
  state.counters["covisibility_share"] = covisibility_ms / s[1].total_ms;
  state.counters["with_fusion_share"] = s[1].landmarks_and_covisibility_ms / s[1].total_ms;
}

BENCHMARK_CAPTURE(loop_closing, pinhole, false)
    ->Arg(300)
    ->Arg(1000)
    ->Arg(3000)
    ->Iterations(1)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(loop_closing, fisheye, true)
    ->Arg(1000)
    ->Iterations(1)
    ->Unit(benchmark::kMillisecond);

}  // namespace
