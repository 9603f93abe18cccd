#pragma once

#include <filesystem>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/eval/evaluation.hpp"
#include "fastloop/eval/loop_stages.hpp"
#include "fastloop/io/trajectory.hpp"

namespace fastloop::eval {

using Json = nlohmann::ordered_json;

/// A line of events.jsonl.
struct RunEvent {
  Nanoseconds stamp_ns = 0;
  std::string kind, reason;
};

/// A line of loops.jsonl whose loop was accepted.
struct RunLoop {
  Nanoseconds stamp_ns = 0;
  unsigned keyframe = 0;
  bool applied = false, merge = false;
  std::string reason;
  std::size_t keyframes_moved = 0, landmarks_joined = 0, observations_added = 0;
  StageList stages_ms;  ///< empty after a run with --deterministic
};

/// What `fastloop run` left behind (docs/outputs.md).
struct RunFolder {
  std::filesystem::path path;
  Json summary, timing;
  std::vector<RunEvent> events;
  std::vector<RunLoop> loops;                ///< accepted ones, in order
  std::size_t refused_candidates = 0;        ///< keyframes with candidates and no loop
  std::vector<io::StampedPose> final_poses;  ///< trajectory_body.txt; empty when never tracked
  std::vector<io::StampedPose> live_poses;   ///< trajectory_live.txt

  /// Loops and merges that were applied.
  std::vector<RunLoop> applied(bool merge) const;
  /// Tracking times of the frames within `around_s` of an applied correction, ms.
  std::vector<double> tracking_around_loops_ms(double around_s = 2) const;
};

/// @throws InputError naming the file that is missing or cannot be understood
RunFolder read_run_folder(const std::filesystem::path& folder);

/// Whether the stages of the accepted loops sum to what the run measured around them, within 2 %;
/// otherwise what is wrong. Nothing to check after a run with --deterministic or without loops.
std::optional<std::string> check_stage_sums(const RunFolder& run);

}  // namespace fastloop::eval
