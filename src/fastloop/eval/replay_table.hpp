#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

#include "fastloop/eval/loop_table.hpp"
#include "fastloop/loop/loop_replay.hpp"

namespace fastloop::eval {

/// One recorded loop, closed again and again with several back ends.
struct ReplayCase {
  std::string name;
  std::size_t keyframes = 0, landmarks = 0;
  std::size_t poses = 0, edges = 0;  ///< of the pose graph, without the pairs that this loop joins
  double map_mib = 0;                ///< heap that the map holds; 0: not measured
  std::string verdict, reason;
  bool merge = false;
  bool decisions_equal = true;         ///< all back ends took the same ones
  double largest_pose_difference = 0;  ///< between the first back end and any other, m or rad
  std::vector<std::string> notes;
  /// [back ends][runs]; empty for a back end that was left out.
  std::vector<std::vector<TimedStages>> runs;
};

struct ReplayPlan {
  std::vector<loop::Backend> backends;
  std::vector<bool> left_out;  ///< [back ends]
  int warm_up = 1, runs = 5;
};

/// Replays a pending loop with each back end in turn. A note tells when stages do not sum to the
/// total within 2 % (median of the runs), or are in no column of the paper.
ReplayCase measure_replay(const std::string& name,
                          const std::shared_ptr<const map::Snapshot>& snapshot,
                          const loop::LoopRequest& request, const ReplayPlan& plan);

/// @param kind  "bench replay" or "bench scale"
Json replay_table_json(const BenchInfo& info, const std::string& kind,
                       const std::vector<ReplayCase>& cases);
/// Every stage of every case beside its columns.
std::string replay_table_markdown(const Json& table);
/// One line for each case, back end and stage or column.
std::string replay_table_csv(const Json& table);

/// What a chart of a scale table shows on its x axis.
enum class ScaleAxis { kPoses, kEdges };
/// Speed-up of each column against poses or edges, as an SVG element; empty with one back end.
std::string speed_up_chart(const Json& table, ScaleAxis axis, const std::string& backend);
/// Time of whole loop closing against poses, a line for each back end.
std::string time_chart(const Json& table);
/// Speed-up charts against poses and edges of all back ends, as one SVG file. Empty with one back
/// end.
std::string speed_up_svg(const Json& table);

}  // namespace fastloop::eval
