#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "fastloop/loop/loop_closer.hpp"
#include "fastloop/loop/loop_request.hpp"
#include "fastloop/map/map_file.hpp"

namespace fastloop::loop {

/// What one repetition decided, and how long it took.
struct ReplayRun {
  LoopCloser::Outcome outcome;
  map::CorrectionOutcome applied;
  /// Detection, correction and applying, the latter split into "apply_check", "apply_poses",
  /// "apply_landmarks" and "apply_covisibility". Names of the report's stages otherwise.
  std::vector<std::pair<std::string, double>> stages_ms;
  double total_ms = 0;  ///< without "graph_finish", which only makes poses comparable
  double total_without_graph_ms = 0;  ///< nor "graph_build" and "graph_solve"

  /// Stages that make landmarks and covisibility follow, joining of landmarks included:
  /// "landmarks", "connections", "apply_landmarks", "apply_covisibility".
  double landmarks_and_covisibility_ms() const;
};

/// Loop closing of one recorded keyframe with one back end, as often as wanted.
class LoopReplay {
 public:
  /// Makes all keyframes of the map known. @param options  `inertial` is taken from the request
  LoopReplay(std::shared_ptr<const map::Snapshot> snapshot, const LoopRequest& request,
             Backend backend, LoopOptions options = {});

  /// Detects, computes the correction and applies it to a copy of the map, as if for the first
  /// time.
  ReplayRun run();
  Backend backend() const { return closer_->backend(); }

 private:
  std::shared_ptr<const map::Snapshot> snapshot_;
  LoopRequest request_;
  std::unique_ptr<LoopCloser> closer_;
};

/// Medians over the repetitions of one replay.
struct ReplaySummary {
  Backend backend = Backend::kAuto;
  int repeats = 0;
  double total_ms = 0, total_without_graph_ms = 0, landmarks_and_covisibility_ms = 0;
  std::vector<std::pair<std::string, double>> stages_ms;
  ReplayRun last;
};

/// Repeats several replays in turn, so that what else the machine does hits all of them alike; one
/// unmeasured repetition of each comes first.
std::vector<ReplaySummary> repeat_replays(std::span<LoopReplay> replays, int repeats);

/// All integers of the decision: verdicts, candidates, counts, joined landmarks, new observations,
/// moved keyframes. Equal for all back ends.
std::uint64_t decision_digest(const LoopCloser::Outcome& outcome);
/// The corrected poses, rounded to 1e-5. Two solvers may differ by less and still round
/// differently; see largest_pose_difference.
std::uint64_t pose_digest(const LoopCloser::Outcome& outcome);
/// Between the corrected poses of two outcomes with the same keyframes: the larger of metres and
/// radians; infinite when the keyframes differ.
double largest_pose_difference(const LoopCloser::Outcome& a, const LoopCloser::Outcome& b);

/// The request that a map file carries.
/// @throws InputError naming the file when there is none or it does not fit the map
LoopRequest request_of(const map::LoadedMap& loaded, const std::filesystem::path& file);

}  // namespace fastloop::loop
