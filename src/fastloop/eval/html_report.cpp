#include "fastloop/eval/html_report.hpp"

#include <algorithm>
#include <cmath>

#include "fastloop/core/error.hpp"
#include "fastloop/eval/html.hpp"
#include "fastloop/eval/plot.hpp"
#include "fastloop/eval/svg.hpp"

namespace fastloop::eval {
namespace {

constexpr const char* kTruthColour = "#8b939c";
constexpr const char* kFinalColour = "#1f6fc4";
constexpr const char* kLiveColour = "#e08a1e";
constexpr const char* kLoopColour = "#2a7f3f";
constexpr const char* kMergeColour = "#8a3fb0";
constexpr const char* kLostColour = "#c42a2a";

struct Errors {
  std::optional<Evaluation> final_poses, live_poses;
};

std::optional<Evaluation> try_evaluate(const ReportInput& input,
                                       const std::vector<io::StampedPose>& poses) {
  if (!input.ground_truth || poses.size() < 3) return std::nullopt;
  try {
    return evaluate(input.ground_truth->poses, poses, {});
  } catch (const InvalidArgument&) {
    return std::nullopt;  // a run too short to be aligned is shown without errors
  }
}

Errors errors_of(const ReportInput& input) {
  return {try_evaluate(input, input.run.final_poses), try_evaluate(input, input.run.live_poses)};
}

Json errors_json(const std::optional<Evaluation>& e) {
  if (!e) return {};
  return {{"ate_m", {{"rmse", e->ate_m.rmse}, {"median", e->ate_m.median}, {"max", e->ate_m.max}}},
          {"coverage_percent", 100 * e->coverage},
          {"path_length_m", e->path_length_m},
          {"end_drift_percent", e->end_drift_percent}};
}

Json json_of(const Errors& errors) {
  return {{"final", errors_json(errors.final_poses)}, {"live", errors_json(errors.live_poses)}};
}

double seconds_of(const ReportInput& input, Nanoseconds stamp_ns) {
  return to_seconds(stamp_ns - input.run.timing.at("first_stamp_ns").get<Nanoseconds>());
}

/// Loops, merges and losses as vertical lines over time.
std::vector<Mark> marks_of(const ReportInput& input) {
  std::vector<Mark> marks;
  for (const RunEvent& e : input.run.events) {
    const double t = seconds_of(input, e.stamp_ns);
    if (e.kind == "loop_closed") marks.push_back({t, kLoopColour, "loop closed"});
    if (e.kind == "maps_merged") marks.push_back({t, kMergeColour, "maps merged"});
    if (e.kind == "lost" || e.kind == "recently_lost") marks.push_back({t, kLostColour, "lost"});
  }
  return marks;
}

void add_cards(HtmlPage& page, const ReportInput& input, const Json& evaluation) {
  const Json &s = input.run.summary, &t = input.run.timing;
  const auto of = [](const Json& j, const std::string& file, const std::string& key, int decimals,
                     const std::string& unit = "") {
    return number_html(file + "." + key, j.at(key), decimals, unit);
  };
  std::vector<std::pair<std::string, std::string>> cards;
  const Json &final_poses = evaluation.at("final"), &live = evaluation.at("live");
  if (!final_poses.is_null())
    cards.emplace_back(
        "ATE, after all corrections",
        number_html("evaluation.final.ate_m.rmse", final_poses["ate_m"]["rmse"], 4, "m"));
  if (!live.is_null())
    cards.emplace_back("ATE, as known at the time",
                       number_html("evaluation.live.ate_m.rmse", live["ate_m"]["rmse"], 4, "m"));
  if (!final_poses.is_null())
    cards.emplace_back("path", number_html("evaluation.final.path_length_m",
                                           final_poses["path_length_m"], 1, "m"));
  cards.emplace_back("loops closed", of(s, "summary", "loops_closed", 0));
  cards.emplace_back("maps merged", of(s, "summary", "maps_merged", 0));
  cards.emplace_back("frames", of(s, "summary", "frames", 0));
  cards.emplace_back("tracked", of(s, "summary", "tracked_percent", 1, "%"));
  cards.emplace_back("keyframes", of(s, "summary", "keyframes", 0));
  cards.emplace_back("landmarks", of(s, "summary", "landmarks", 0));
  cards.emplace_back("frames a second", of(t, "timing", "fps", 1));
  cards.emplace_back("memory, peak", number_html("timing.memory.peak_mib",
                                                 t.at("memory").at("peak_mib"), 0, "MiB"));
  if (const Json device = t.value("device", Json()); !device.is_null())
    cards.emplace_back("memory of the device",
                       number_html("timing.device.peak_mib", device.at("peak_mib"), 0, "MiB"));
  page.cards(cards);
}

std::vector<Point> projected(const std::vector<SE3>& poses, std::pair<int, int> view) {
  std::vector<Point> points;
  for (const SE3& p : poses)
    points.push_back({p.translation[view.first], p.translation[view.second]});
  return points;
}

std::vector<SE3> poses_only(const std::vector<io::StampedPose>& stamped) {
  std::vector<SE3> poses;
  for (const io::StampedPose& p : stamped) poses.push_back(p.T_world_x);
  return poses;
}

std::vector<bool> gaps_of(const std::vector<io::StampedPose>& stamped) {
  std::vector<Nanoseconds> stamps;
  for (const io::StampedPose& p : stamped) stamps.push_back(p.stamp_ns);
  return gaps(stamps);
}

/// Where the loops were closed.
Series loops_on_path(const ReportInput& input, const Evaluation& e, std::pair<int, int> view) {
  Series s{"", kLoopColour, {}, {}, 0, true};
  for (const RunLoop& loop : input.run.loops) {
    const auto at = std::lower_bound(e.stamps_ns.begin(), e.stamps_ns.end(), loop.stamp_ns);
    if (!loop.applied || at == e.stamps_ns.end()) continue;
    const Vector3d& p = e.estimate[static_cast<std::size_t>(at - e.stamps_ns.begin())].translation;
    s.points.push_back({p[view.first], p[view.second]});
  }
  if (!s.points.empty()) s.name = "loop closed";
  return s;
}

/// Paths seen from above. Without ground truth nothing is aligned: both lie in the map's world.
std::string path_chart(const ReportInput& input, const Errors& errors) {
  static constexpr const char* kAxisName[] = {"x [m]", "y [m]", "z [m]"};
  Chart chart;
  chart.equal = true;
  std::pair<int, int> view{0, 1};
  if (errors.final_poses) {
    const Evaluation& e = *errors.final_poses;
    view = view_axes(e.reference);
    chart.series.push_back(
        {"ground truth", kTruthColour, projected(e.reference, view), gaps(e.stamps_ns), 3.5});
    if (errors.live_poses)
      chart.series.push_back({"at the time", kLiveColour,
                              projected(errors.live_poses->estimate, view),
                              gaps(errors.live_poses->stamps_ns), 1.2});
    chart.series.push_back(
        {"after loops", kFinalColour, projected(e.estimate, view), gaps(e.stamps_ns), 1.2});
    chart.series.push_back(loops_on_path(input, e, view));
  } else if (!input.run.final_poses.empty()) {
    view = view_axes(poses_only(input.run.final_poses));
    chart.series.push_back({"at the time", kLiveColour,
                            projected(poses_only(input.run.live_poses), view),
                            gaps_of(input.run.live_poses), 1.2});
    chart.series.push_back({"after loops", kFinalColour,
                            projected(poses_only(input.run.final_poses), view),
                            gaps_of(input.run.final_poses), 1.2});
  }
  chart.x_label = kAxisName[view.first];
  chart.y_label = kAxisName[view.second];
  return draw_chart(chart, 420);
}

std::string error_chart(const ReportInput& input, const Errors& errors) {
  Chart chart;
  chart.x_label = "time [s]";
  chart.y_label = "position error [m]";
  chart.marks = marks_of(input);
  const auto add = [&](const std::optional<Evaluation>& e, const char* name, const char* colour) {
    if (!e) return;
    Series s{name, colour, {}, gaps(e->stamps_ns), 1.2};
    for (std::size_t i = 0; i < e->errors_m.size(); ++i)
      s.points.push_back({seconds_of(input, e->stamps_ns[i]), e->errors_m[i]});
    chart.series.push_back(s);
  };
  add(errors.live_poses, "at the time", kLiveColour);
  add(errors.final_poses, "after loops", kFinalColour);
  return draw_chart(chart, 420);
}

void add_trajectory(HtmlPage& page, const ReportInput& input, const Errors& errors,
                    const Json& evaluation) {
  if (input.run.final_poses.empty()) return;
  page.section("Trajectory");
  page.begin_figures();
  page.figure(path_chart(input, errors),
              errors.final_poses ? "Seen from above, each path aligned with the ground truth "
                                   "(rotation and translation, no scale)"
                                 : "Seen from above; no ground truth");
  page.figure(error_chart(input, errors), "Distance to the ground truth");
  page.end_figures();
  if (!errors.final_poses) return;
  std::vector<std::vector<std::string>> rows;
  for (const auto& [key, name] :
       {std::pair{"final", "after all corrections"}, std::pair{"live", "as known at the time"}}) {
    const Json& e = evaluation.at(key);
    if (e.is_null()) continue;
    const std::string at = std::string("evaluation.") + key + ".";
    rows.push_back({name, number_html(at + "ate_m.rmse", e["ate_m"]["rmse"], 4),
                    number_html(at + "ate_m.median", e["ate_m"]["median"], 4),
                    number_html(at + "ate_m.max", e["ate_m"]["max"], 4),
                    number_html(at + "end_drift_percent", e["end_drift_percent"], 3),
                    number_html(at + "coverage_percent", e["coverage_percent"], 1)});
  }
  page.table({"against " + escaped(input.ground_truth_name), "ATE RMSE [m]", "median [m]",
              "max [m]", "drift at the end [% of path]", "coverage [%]"},
             rows);
}

/// Median and worst of the frames in each of many short stretches.
std::string tracking_chart(const ReportInput& input) {
  const auto t = input.run.timing.at("track_by_frame").at("t_s").get<std::vector<double>>();
  const auto ms = input.run.timing.at("track_by_frame").at("ms").get<std::vector<double>>();
  const std::size_t stretches = std::clamp<std::size_t>(t.size() / 4, 1, 220);
  Series worst{"worst", "#c4441f", {}, {}, 1}, median{"median", kFinalColour, {}, {}, 1.6};
  for (std::size_t i = 0; i < stretches && !t.empty(); ++i) {
    const std::size_t begin = i * t.size() / stretches;
    const std::size_t end = std::max(begin + 1, (i + 1) * t.size() / stretches);
    const SampleStatistics s =
        describe({ms.begin() + static_cast<std::ptrdiff_t>(begin),
                  ms.begin() + static_cast<std::ptrdiff_t>(std::min(end, ms.size()))});
    worst.points.push_back({t[begin], s.max});
    median.points.push_back({t[begin], s.median});
  }
  Chart chart;
  chart.x_label = "time [s]";
  chart.y_label = "tracking a frame [ms]";
  chart.series = {worst, median};
  chart.marks = marks_of(input);
  return draw_chart(chart, 300);
}

/// Times of each loop, by the columns of the paper.
void add_loops(HtmlPage& page, const ReportInput& input) {
  page.section("Loops");
  if (input.run.loops.empty()) {
    page.paragraph("No loop was closed. " + std::to_string(input.run.refused_candidates) +
                   " keyframes had candidates (loops.jsonl says why none was taken).");
    return;
  }
  std::vector<std::string> head{"time [s]", "kind", "keyframe", "keyframes moved",
                                "landmarks joined"};
  for (const PaperColumn& c : paper_columns()) head.push_back(std::string(c.title) + " [ms]");
  std::vector<std::vector<std::string>> rows;
  for (std::size_t i = 0; i < input.run.loops.size(); ++i) {
    const RunLoop& l = input.run.loops[i];
    std::vector<std::string> cells{decimal(seconds_of(input, l.stamp_ns), 1),
                                   escaped(!l.applied ? "refused: " + l.reason
                                           : l.merge  ? "merge"
                                                      : "loop"),
                                   std::to_string(l.keyframe), std::to_string(l.keyframes_moved),
                                   std::to_string(l.landmarks_joined)};
    const PaperTimes times = paper_times(l.stages_ms);
    for (const PaperColumn& c : paper_columns())
      cells.push_back(l.stages_ms.empty() ? "-"
                                          : number_html("loops." + std::to_string(i) + "." + c.key,
                                                        Json(c.value(times)), 2));
    rows.push_back(cells);
  }
  page.table(head, rows);
  page.paragraph(
      "Total = region detection + loop correction; loop correction = loop fusion + graph "
      "optimisation + what is left. " +
      std::to_string(input.run.refused_candidates) +
      " more keyframes had candidates that were not taken.");
}

void add_events(HtmlPage& page, const ReportInput& input) {
  page.section("Time line");
  page.begin_figures();
  page.figure(tracking_chart(input), "Time from images to pose; dashed: what happened when");
  std::vector<std::vector<std::string>> rows;
  for (const RunEvent& e : input.run.events)
    rows.push_back({decimal(seconds_of(input, e.stamp_ns), 1),
                    "<td class=\"words\">" + escaped(e.kind) + "</td>",
                    "<td class=\"long\">" + escaped(e.reason) + "</td>"});
  page.table({"time [s]", "<th class=\"words\">event</th>", "<th class=\"words\">reason</th>"},
             rows);
  page.end_figures();
}

void add_stages(HtmlPage& page, const ReportInput& input) {
  page.section("Stage times");
  std::vector<std::vector<std::string>> rows;
  for (const auto& [stage, s] : input.run.timing.at("stages").items()) {
    const std::string at = "timing.stages." + stage + ".";
    std::vector<std::string> cells{escaped(stage), number_html(at + "count", s.at("count"), 0)};
    for (const char* key : {"mean_ms", "p50_ms", "p95_ms", "p99_ms", "max_ms"})
      cells.push_back(number_html(at + key, s.at(key), 2));
    rows.push_back(cells);
  }
  page.table({"stage", "count", "mean [ms]", "p50 [ms]", "p95 [ms]", "p99 [ms]", "max [ms]"}, rows);
}

void add_memory(HtmlPage& page, const ReportInput& input) {
  const Json& samples = input.run.timing.at("memory").at("samples");
  if (samples.size() < 2) return;
  page.section("Memory and map");
  const auto chart = [&](const char* key, const char* label, const char* colour) {
    Chart c;
    c.x_label = "time [s]";
    c.y_label = label;
    Series s{"", colour, {}, {}, 1.6};
    for (const Json& m : samples)
      s.points.push_back({m.at("t_s").get<double>(), m.at(key).get<double>()});
    c.series = {s};
    c.marks = marks_of(input);
    return draw_chart(c, 240);
  };
  page.begin_figures();
  page.figure(chart("resident_mib", "resident [MiB]", "#444c56"), "Memory of the process");
  page.figure(chart("keyframes", "keyframes", kFinalColour), "Keyframes in the map");
  page.end_figures();
}

void add_machine(HtmlPage& page, const ReportInput& input) {
  page.section("Machine");
  const Json& m = input.run.timing.at("machine");
  const auto text = [&](const char* key) {
    return "<td class=\"words\">" + escaped(m.at(key).get<std::string>()) + "</td>";
  };
  page.table(
      {"", ""},
      {{"CPU", text("cpu")},
       {"cores",
        "<td class=\"words\">" + number_html("timing.machine.cores", m.at("cores"), 0) + "</td>"},
       {"memory", "<td class=\"words\">" +
                      number_html("timing.machine.memory_gib", m.at("memory_gib"), 1, "GiB") +
                      "</td>"},
       {"compiler", text("compiler")},
       {"build", text("build")},
       {"commit", text("commit")}});
}

}  // namespace

Json evaluation_json(const ReportInput& input) {
  return json_of(errors_of(input));
}

std::string html_report(const ReportInput& input) {
  const Json& s = input.run.summary;
  const Errors errors = errors_of(input);
  const Json evaluation = json_of(errors);
  HtmlPage page;
  try {
    add_cards(page, input, evaluation);
    add_trajectory(page, input, errors, evaluation);
    add_loops(page, input);
    add_events(page, input);
    add_stages(page, input);
    add_memory(page, input);
    for (std::size_t i = 0; i < input.benches.size(); ++i) add_bench(page, input.benches[i], i);
    add_machine(page, input);
  } catch (const Json::exception& e) {
    throw InvalidArgument(std::string("a result file is not as fastloop writes it: ") + e.what());
  }
  const std::string version = s.value("version", "");
  return page.str("fastloop: " + s.value("dataset", std::string("run")),
                  s.value("mode", "") + ", " + decimal(s.value("seconds", 0.0), 1) +
                      " s of recording, fastloop " + version + ", commit " +
                      input.run.timing.at("machine").value("commit", ""));
}

}  // namespace fastloop::eval
