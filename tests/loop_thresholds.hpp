#pragma once

#include <gtest/gtest.h>

#include <algorithm>

#include "simulated_loop.hpp"

namespace fastloop::loop::testing {

/// A simulated map with its pending loop, all keyframes known; made once.
struct Known {
  sim::SimulatedMap world = sim::simulate_map(small_world());
  std::shared_ptr<const map::Snapshot> snapshot = world.map.publish();
  LoopCloser closer{LoopOptions{}, Backend::kCpu, place::default_vocabulary()};
  Known() { closer.add_all(*snapshot); }
};

inline const Known& known() {
  static const Known k;
  return k;
}

class Thresholds : public ::testing::Test {
 protected:
  Verified verify(KeyframeId candidate) const {
    std::vector<Verified> one(1);
    one[0].report.keyframe = candidate;
    StageClock clock;
    Verifier(options_, Executor::cpu())
        .verify(map_, current_, known().closer.database(), one, clock);
    return one[0];
  }
  Verified verify() const { return verify(matched_); }
  /// PS1 at the true place.
  Verified recheck() const {
    StageClock clock;
    return Verifier(options_, Executor::cpu())
        .recheck(map_, current_, matched_, confirmed().match.T_camera_world, clock);
  }
  static const Verified& confirmed() {
    static const Verified v = [] {
      std::vector<Verified> one(1);
      one[0].report.keyframe = known().world.expected_matches.front();
      StageClock clock;
      Verifier(LoopOptions{}, Executor::cpu())
          .verify(*known().snapshot, known().world.current, known().closer.database(), one, clock);
      return one[0];
    }();
    return v;
  }
  static const GateReading* gate(const CandidateReport& report, const std::string& name) {
    const auto it = std::find_if(report.gates.begin(), report.gates.end(),
                                 [&](const GateReading& g) { return g.gate == name; });
    return it == report.gates.end() ? nullptr : &*it;
  }
  LoopDetector::Result detect() const {
    LoopDetector detector(options_, Executor::cpu());
    return detector.detect(map_, current_, known().closer.database());
  }

  const map::Snapshot& map_ = *known().snapshot;
  const KeyframeId current_ = known().world.current;
  const KeyframeId matched_ = known().world.expected_matches.front();
  LoopOptions options_;
};

}  // namespace fastloop::loop::testing
