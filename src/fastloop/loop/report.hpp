#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "fastloop/core/ids.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/geometry/se3.hpp"

namespace fastloop::loop {

enum class Verdict { kRejected, kWaiting, kAccepted };
const char* to_string(Verdict verdict);

/// One number compared with its threshold.
struct GateReading {
  std::string gate;
  double value = 0, threshold = 0;
  bool passed = false;
};

/// How an accepted candidate lies to the keyframe: what the loop states.
struct MeasuredLoop {
  Nanoseconds matched_stamp_ns = 0;  ///< of the candidate
  SE3 T_matched_current;             ///< between the bodies of both keyframes, metres
};

/// What became of one candidate.
struct CandidateReport {
  KeyframeId keyframe;
  bool merge = false;    ///< lies in another map
  bool recheck = false;  ///< a waiting candidate seen again from this keyframe [PS1]
  float score = 0;       ///< of the words
  int shared_words = 0, descriptor_matches = 0;
  std::vector<GateReading> gates;  ///< in order; ends with the first one not passed
  Verdict verdict = Verdict::kRejected;
  std::string reason;
  std::optional<MeasuredLoop> measured;  ///< accepted candidates
};

/// Why a loop was taken or refused at one keyframe.
struct LoopReport {
  KeyframeId keyframe;
  Nanoseconds stamp_ns = 0;
  std::vector<CandidateReport> candidates;
  Verdict verdict = Verdict::kRejected;
  std::string reason;
  std::vector<std::pair<std::string, double>> times_ms;  ///< stages in order
};

}  // namespace fastloop::loop
