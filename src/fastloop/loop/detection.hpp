#pragma once

#include <optional>

#include "fastloop/loop/verification.hpp"
#include "fastloop/place/candidate_ranking.hpp"

namespace fastloop::loop {

/// A candidate that was verified, but not by enough keyframes yet.
struct WaitingRegion {
  KeyframeId last_keyframe, matched;
  SE3 T_last_matched;  ///< left cameras
  int confirmations = 0, misses = 0;
};

/// Finds out whether a keyframe closes a loop or joins two maps: candidates by words, verification
/// by geometry, confirmation over time, gates on the correction that would follow. Call it for every
/// keyframe in order; synchronous, one thread at a time.
class LoopDetector {
 public:
  LoopDetector(const LoopOptions& options, const StepExecutors& executors);

  struct Result {
    LoopReport report;
    std::optional<RegionMatch> match;  ///< when accepted
  };
  /// @param database  contains `keyframe` and all others that may be found
  Result detect(const map::Snapshot& snapshot, KeyframeId keyframe,
                const place::PlaceDatabase& database);

  /// Forgets what is waiting; to be called after the map was corrected.
  void forget() { waiting_ = {}; }

  /// What is waiting: a loop and a merge. To be saved and set for a replay.
  struct Waiting {
    std::optional<WaitingRegion> loop, merge;
  };
  const Waiting& waiting() const { return waiting_; }
  void set_waiting(const Waiting& waiting) { waiting_ = waiting; }

 private:
  bool is_ready(const map::Snapshot&, KeyframeId) const;
  std::vector<place::RankedCandidate> rank(const map::Snapshot&, KeyframeId,
                                           const place::PlaceDatabase&,
                                           const std::vector<place::PlaceCandidate>& found) const;
  std::vector<Verified> candidates(const map::Snapshot&, KeyframeId,
                                   const place::PlaceDatabase&) const;
  /// Re-checks what is waiting; true when it is confirmed now.
  bool recheck(const map::Snapshot&, KeyframeId, std::optional<WaitingRegion>& waiting,
               StageClock& clock, Result& result) const;
  /// Gates on the correction; notes the reason when it cannot be.
  bool is_possible(const map::Snapshot&, RegionMatch& match, CandidateReport& report) const;
  /// The verified candidate of a kind with most matches, unless others contradict it.
  Verified* best_of(const map::Snapshot&, std::span<Verified> verified, bool merge) const;
  void choose(const map::Snapshot&, KeyframeId, std::span<Verified> verified, bool merge,
              Result& result);
  void accept(const map::Snapshot& snapshot, const RegionMatch& match, CandidateReport& report,
              Result& result) const;

  LoopOptions options_;
  StepExecutors executors_;
  Verifier verifier_;
  Waiting waiting_;
};

}  // namespace fastloop::loop
