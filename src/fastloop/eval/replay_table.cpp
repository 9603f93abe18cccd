#include "fastloop/eval/replay_table.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/map/essential_graph.hpp"

namespace fastloop::eval {
namespace {

/// Size of the graph that the loop's correction is spread over.
void count_graph(const map::Snapshot& snapshot, const loop::LoopRequest& request,
                 const map::LoopCorrection& correction, ReplayCase& c) {
  if (correction.kind != map::LoopCorrection::Kind::kLoop) return;
  map::EssentialGraphOptions options;
  options.kind =
      request.inertial ? optimization::PoseGraphKind::kYaw : optimization::PoseGraphKind::kSim3;
  map::EssentialGraph graph;
  map::build_essential_graph(snapshot, correction.map, {correction.edge, {}, {}, correction.edge.a},
                             options, graph);
  c.poses = graph.keyframe_of_vertex.size();
  c.edges = graph.problem.edges.size();
}

void compare_outcomes(const std::vector<loop::LoopCloser::Outcome>& outcomes, ReplayCase& c) {
  for (std::size_t i = 1; i < outcomes.size(); ++i) {
    c.decisions_equal &= loop::decision_digest(outcomes[i]) == loop::decision_digest(outcomes[0]);
    c.largest_pose_difference = std::max(c.largest_pose_difference,
                                         loop::largest_pose_difference(outcomes[0], outcomes[i]));
  }
}

/// Stages of a loop that is part of the published method; "graph_finish" is not in the total.
StageList published(const StageList& stages) {
  StageList list;
  for (const auto& stage : stages)
    if (paper_stage(stage.first) != PaperStage::kNotPublished) list.push_back(stage);
  return list;
}

void check_stages(const std::string& backend, const std::vector<TimedStages>& runs, ReplayCase& c) {
  if (runs.empty()) return;
  for (const std::string& stage : paper_times(runs.front().stages_ms).unknown)
    c.notes.push_back("the stage '" + stage + "' belongs to no column of the table");
  // The run in the middle: an interrupt between two stages is no fault of theirs.
  std::vector<TimedStages> sorted = runs;
  const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), middle, sorted.end(),
                   [](const auto& a, const auto& b) { return a.total_ms < b.total_ms; });
  if (const auto fault = sum_mismatch(published(middle->stages_ms), middle->total_ms))
    c.notes.push_back(backend + ": " + *fault);
}

Json backend_json(const std::vector<TimedStages>& runs) {
  if (runs.empty()) return {};
  std::vector<PaperTimes> columns;
  std::vector<double> totals;
  for (const TimedStages& r : runs) {
    columns.push_back(paper_times(r.stages_ms));
    totals.push_back(r.total_ms);
  }
  Json stages;
  for (std::size_t s = 0; s < runs.front().stages_ms.size(); ++s) {
    std::vector<double> values;
    for (const TimedStages& r : runs) values.push_back(r.stages_ms.at(s).second);
    stages[runs.front().stages_ms[s].first] = to_json(describe(std::move(values)));
  }
  return {{"runs", runs.size()},
          {"measured_total_ms", to_json(describe(std::move(totals)))},
          {"columns_ms", columns_json(columns)},
          {"stages_ms", stages}};
}

Json case_json(const ReplayCase& c, const std::vector<std::string>& backends) {
  Json j{{"name", c.name},
         {"keyframes", c.keyframes},
         {"landmarks", c.landmarks},
         {"poses", c.poses},
         {"edges", c.edges},
         {"map_mib", c.map_mib > 0 ? Json(c.map_mib) : Json()},
         {"verdict", c.verdict},
         {"reason", c.reason},
         {"merge", c.merge},
         {"decisions_equal", c.decisions_equal},
         {"largest_pose_difference", c.largest_pose_difference},
         {"notes", c.notes}};
  j["backends"] = Json::object();
  for (std::size_t b = 0; b < backends.size(); ++b)
    j["backends"][backends[b]] = backend_json(c.runs[b]);
  const Json& base = j["backends"][backends[0]];
  Json speed_ups = Json::object();
  for (std::size_t b = 1; b < backends.size(); ++b) {
    const Json& other = j["backends"][backends[b]];
    if (base.is_null() || other.is_null()) continue;
    for (const PaperColumn& column : paper_columns()) {
      const double ms = other["columns_ms"][column.key]["median"];
      if (ms > 0)
        speed_ups[backends[b]][column.key] =
            base["columns_ms"][column.key]["median"].get<double>() / ms;
    }
  }
  j["speed_up"] = speed_ups;
  return j;
}

}  // namespace

ReplayCase measure_replay(const std::string& name,
                          const std::shared_ptr<const map::Snapshot>& snapshot,
                          const loop::LoopRequest& request, const ReplayPlan& plan) {
  if (plan.left_out.size() != plan.backends.size())
    throw InvalidArgument("measure_replay: every back end is in or out");
  ReplayCase c;
  c.name = name;
  c.keyframes = snapshot->num_keyframes();
  c.landmarks = snapshot->num_landmarks();
  std::vector<loop::LoopReplay> replays;
  replays.reserve(plan.backends.size());
  for (std::size_t b = 0; b < plan.backends.size(); ++b)
    if (!plan.left_out[b]) replays.emplace_back(snapshot, request, plan.backends[b]);
  std::vector<loop::LoopCloser::Outcome> last(replays.size());
  std::vector<TimedSource> sources;
  for (std::size_t r = 0; r < replays.size(); ++r)
    sources.push_back([&replays, &last, r] {
      loop::ReplayRun run = replays[r].run();
      last[r] = std::move(run.outcome);
      return TimedStages{std::move(run.stages_ms), run.total_ms};
    });
  auto measured = measure_in_turn(sources, plan.warm_up, plan.runs);
  c.runs.resize(plan.backends.size());
  std::size_t next = 0;
  for (std::size_t b = 0; b < plan.backends.size(); ++b) {
    if (plan.left_out[b]) continue;
    c.runs[b] = std::move(measured[next++]);
    check_stages(loop::to_string(plan.backends[b]), c.runs[b], c);
  }
  if (last.empty()) return c;
  c.verdict = to_string(last[0].report.verdict);
  c.reason = last[0].report.reason;
  if (last[0].correction) {
    c.merge = last[0].correction->kind == map::LoopCorrection::Kind::kMerge;
    count_graph(*snapshot, request, *last[0].correction, c);
  }
  compare_outcomes(last, c);
  return c;
}

Json replay_table_json(const BenchInfo& info, const std::string& kind,
                       const std::vector<ReplayCase>& cases) {
  Json table = to_json(info, kind);
  table["cases"] = Json::array();
  for (const ReplayCase& c : cases) table["cases"].push_back(case_json(c, info.backends));
  return table;
}

}  // namespace fastloop::eval
