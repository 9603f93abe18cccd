#include "fastloop/eval/loop_stages.hpp"

#include <unordered_map>

namespace fastloop::eval {

PaperStage paper_stage(const std::string& stage) {
  using enum PaperStage;
  static const std::unordered_map<std::string, PaperStage> kStages{
      {"words", kRegionDetection},
      {"query", kRegionDetection},
      {"descriptor_matching", kRegionDetection},
      {"similarity", kRegionDetection},
      {"projection_searches", kRegionDetection},  // PS2a, PS2b, PS3a-c
      {"recheck", kRegionDetection},              // PS1
      {"loop_fusion", kLoopFusion},
      {"graph_build", kGraphOptimisation},
      {"graph_solve", kGraphOptimisation},
      {"correct_poses", kRestOfCorrection},
      {"connections", kRestOfCorrection},
      {"landmarks", kRestOfCorrection},
      {"apply_check", kRestOfCorrection},
      {"apply_poses", kRestOfCorrection},
      {"apply_landmarks", kRestOfCorrection},
      {"apply_covisibility", kRestOfCorrection},
      // The reference's solver stops beside the minimum; a second one goes on from there so that
      // back ends can be compared.
      {"graph_finish", kNotPublished},
  };
  const auto it = kStages.find(stage);
  return it == kStages.end() ? kUnknown : it->second;
}

PaperTimes paper_times(const StageList& stages_ms) {
  PaperTimes t;
  for (const auto& [stage, ms] : stages_ms) {
    switch (paper_stage(stage)) {
      case PaperStage::kRegionDetection:
        t.region_detection += ms;
        break;
      case PaperStage::kLoopFusion:
        t.loop_fusion += ms;
        break;
      case PaperStage::kGraphOptimisation:
        t.graph_optimisation += ms;
        break;
      case PaperStage::kRestOfCorrection:
        t.rest_of_correction += ms;
        break;
      case PaperStage::kNotPublished:
        t.not_published += ms;
        break;
      case PaperStage::kUnknown:
        t.unknown.push_back(stage);
        break;
    }
  }
  return t;
}

const std::array<PaperColumn, 5>& paper_columns() {
  static const std::array<PaperColumn, 5> kColumns{{
      {"total", "total loop closing", [](const PaperTimes& t) { return t.total(); }},
      {"region_detection", "region detection",
       [](const PaperTimes& t) { return t.region_detection; }},
      {"loop_fusion", "loop fusion", [](const PaperTimes& t) { return t.loop_fusion; }},
      {"graph_optimisation", "graph optimisation",
       [](const PaperTimes& t) { return t.graph_optimisation; }},
      {"loop_correction", "loop correction",
       [](const PaperTimes& t) { return t.loop_correction(); }},
  }};
  return kColumns;
}

}  // namespace fastloop::eval
