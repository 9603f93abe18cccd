#pragma once

#include <array>
#include <string>
#include <vector>

#include "fastloop/eval/statistics.hpp"

namespace fastloop::eval {

/// Where a stage of fastloop belongs in the table of the FastLoop paper. This is the only place
/// that says so (the list is in loop_stages.cpp).
enum class PaperStage {
  kRegionDetection,    ///< words, query, verification, PS1 to PS3
  kLoopFusion,         ///< loop landmarks against the connected keyframes
  kGraphOptimisation,  ///< essential graph: building and solving
  kRestOfCorrection,   ///< poses, connections, landmarks, and what the owner of the map does
  kNotPublished,       ///< no part of the published method; measured, in no column
  kUnknown,            ///< not in the list: the list has to be mended
};
PaperStage paper_stage(const std::string& stage);

/// Milliseconds of one loop by the columns of the paper.
struct PaperTimes {
  double region_detection = 0, loop_fusion = 0, graph_optimisation = 0, rest_of_correction = 0;
  double not_published = 0;
  std::vector<std::string> unknown;  ///< stages that are in no column

  double loop_correction() const { return loop_fusion + graph_optimisation + rest_of_correction; }
  double total() const { return region_detection + loop_correction(); }
};
PaperTimes paper_times(const StageList& stages_ms);

/// A column of the table.
struct PaperColumn {
  const char* key;    ///< in JSON and CSV
  const char* title;  ///< in tables
  double (*value)(const PaperTimes&);
};
/// In the order of the paper: total, detection, fusion, graph, correction (fusion and graph
/// included).
const std::array<PaperColumn, 5>& paper_columns();

}  // namespace fastloop::eval
