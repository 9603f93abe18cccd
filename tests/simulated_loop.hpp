#pragma once

#include <concepts>
#include <string>
#include <vector>

#include "fastloop/loop/loop_closer.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/sim/map_worlds.hpp"

namespace fastloop::loop::testing {

/// Loop closing at the last keyframe of a simulated map: no images, no front end, known truth.
struct Attempt {
  sim::SimulatedMap world;
  LoopCloser closer;
  LoopCloser::Outcome outcome;

  template <class Change>
  static LoopOptions options_for(const sim::MapWorldOptions& o, Change change) {
    LoopOptions options;
    options.inertial = o.inertial;
    change(options);
    return options;
  }
  template <class Change = void (*)(LoopOptions&)>
    requires std::invocable<Change, LoopOptions&>
  Attempt(const sim::MapWorldOptions& o, Backend backend, Change change = [](LoopOptions&) {})
      : world(sim::simulate_map(o)),
        closer(options_for(o, change), backend, place::default_vocabulary()) {
    run();
  }
  Attempt(const sim::MapWorldOptions& o, Backend backend, const StepExecutors& executors)
      : world(sim::simulate_map(o)),
        closer(options_for(o, [](LoopOptions&) {}), backend, executors,
               place::default_vocabulary()) {
    run();
  }
  void run() {
    const auto snapshot = world.map.publish();
    for (std::uint32_t i = 0; i < snapshot->keyframe_slots(); ++i)
      if (KeyframeId(i) != world.current) closer.add(*snapshot, KeyframeId(i));
    outcome = closer.process(*snapshot, world.current);
  }
};

inline std::string describe(const LoopReport& r) {
  std::string text = std::string(to_string(r.verdict)) + " " + r.reason + "\n";
  for (const CandidateReport& c : r.candidates) {
    text += "  keyframe " + std::to_string(c.keyframe.value()) + " words " +
            std::to_string(c.shared_words) + " matches " + std::to_string(c.descriptor_matches) +
            ": " + to_string(c.verdict) + " " + c.reason + "\n";
    for (const GateReading& g : c.gates)
      text += "    " + g.gate + " " + std::to_string(g.value) + " / " + std::to_string(g.threshold) + "\n";
  }
  for (const auto& [stage, ms] : r.times_ms) text += "  " + stage + " " + std::to_string(ms) + " ms\n";
  return text;
}

/// The back ends that must decide as the reference does; cuda where there is a device.
inline std::vector<Backend> parallel_backends() {
  std::vector<Backend> backends{Backend::kCpu};
  for (const Backend b : {Backend::kCuda, Backend::kAuto})
    if (resolve(b) == b) backends.push_back(b);
  return backends;
}

/// A small world with a pending loop.
inline sim::MapWorldOptions small_world(std::uint64_t seed = 3) {
  sim::MapWorldOptions o;
  o.keyframes = 120;
  o.features = 600;
  o.seed = seed;
  return o;
}

/// Pose of the body of edge.b in that of edge.a, as it truly is.
inline SE3 true_edge(const sim::SimulatedMap& world, const map::LoopEdge& edge) {
  return world.truth[edge.a.value()].inverse() * world.truth[edge.b.value()];
}

}  // namespace fastloop::loop::testing
