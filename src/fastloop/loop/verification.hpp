#pragma once

#include <span>
#include <vector>

#include "fastloop/loop/options.hpp"
#include "fastloop/loop/region_match.hpp"
#include "fastloop/loop/report.hpp"
#include "fastloop/loop/stage_clock.hpp"
#include "fastloop/loop/step_executors.hpp"
#include "fastloop/map/landmark_arrays.hpp"
#include "fastloop/place/place_database.hpp"

namespace fastloop::loop {

/// What verification found out about one candidate. The report says how far it got.
struct Verified {
  CandidateReport report;
  RegionMatch match;      ///< meaningful when the narrow search passed: num_matches > 0
  int confirmations = 0;  ///< covisible keyframes of the current one that agree
};

/// Decides by geometry whether a keyframe sees the place of another one. Stateless but for options;
/// reads snapshots only. Results do not depend on the executors.
class Verifier {
 public:
  Verifier(const LoopOptions& options, const StepExecutors& executors)
      : options_(options), executors_(executors) {}

  /// Verifies all candidates together: descriptor matches with the candidate's covisibility window,
  /// similarity by RANSAC, wide search [PS2a], refinement, narrow search [PS2b], search from the
  /// covisible keyframes of `current` [PS3a-c].
  /// @param verified  [candidates] reports with keyframe, merge and score filled in
  void verify(const map::Snapshot& snapshot, KeyframeId current,
              const place::PlaceDatabase& database, std::span<Verified> verified,
              StageClock& clock) const;

  /// Looks for a waiting candidate again from a later keyframe, where prediction says [PS1].
  Verified recheck(const map::Snapshot& snapshot, KeyframeId current, KeyframeId matched,
                   const SE3& predicted_T_camera_world, StageClock& clock) const;

 private:
  struct Hypothesis;
  void match_windows(const map::Snapshot&, KeyframeId current, const place::PlaceDatabase&,
                     std::span<Hypothesis>) const;
  void solve_similarities(const map::Snapshot&, KeyframeId current, std::span<Hypothesis>) const;
  void guide(const map::Snapshot&, KeyframeId current, std::span<Hypothesis>) const;
  void confirm(const map::Snapshot&, KeyframeId current, std::span<Hypothesis>) const;
  bool refine(const map::Snapshot&, KeyframeId current, Hypothesis&, int min_inliers) const;
  /// Searches the cloud of every living candidate in the current keyframe.
  void search(const map::Snapshot&, KeyframeId current, std::span<Hypothesis>, float radius_px,
              int max_distance) const;

  LoopOptions options_;
  StepExecutors executors_;
};

/// A keyframe and the best covisible ones; the landmarks they see are what is known of a place.
std::vector<KeyframeId> window_of(const map::Snapshot& snapshot, KeyframeId keyframe,
                                  std::size_t covisibles);

}  // namespace fastloop::loop
