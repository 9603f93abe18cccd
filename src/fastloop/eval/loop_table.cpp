#include "fastloop/eval/loop_table.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "fastloop/core/timing.hpp"

namespace fastloop::eval {
namespace {

/// An accuracy is kept when the median error grew by no more than the larger of these.
constexpr double kKeptRelative = 0.05, kKeptM = 0.002;

template <class Value>
std::vector<double> over_runs(const std::vector<RunMeasurement>& runs, const Value& value) {
  std::vector<double> values;
  for (const RunMeasurement& run : runs) values.push_back(value(run));
  return values;
}

template <class T, class Member>
std::vector<T> pooled(const std::vector<RunMeasurement>& runs, const Member& member) {
  std::vector<T> all;
  for (const RunMeasurement& run : runs)
    all.insert(all.end(), (run.*member).begin(), (run.*member).end());
  return all;
}

Json statistics_or_null(std::vector<double> values) {
  return values.empty() ? Json() : to_json(describe(std::move(values)));
}

/// Null unless every run used a device.
Json device_json(const std::vector<RunMeasurement>& runs,
                 std::optional<double> RunMeasurement::*member) {
  std::vector<double> values;
  for (const RunMeasurement& run : runs)
    if (run.*member) values.push_back(*(run.*member));
  return values.size() == runs.size() ? statistics_or_null(values) : Json();
}

Json tracking_json(std::size_t frames, double p50, double p99, double worst) {
  return {{"frames", frames}, {"p50", p50}, {"p99", p99}, {"worst", worst}};
}

Json backend_json(const std::vector<RunMeasurement>& runs, bool has_truth) {
  const RunMeasurement& first = runs.front();
  const bool same = std::all_of(runs.begin(), runs.end(), [&](const RunMeasurement& r) {
    return r.loops.size() == first.loops.size() && r.merges_ms.size() == first.merges_ms.size() &&
           r.ate_m == first.ate_m && r.keyframes == first.keyframes;
  });
  const StageStatistics around =
      summarize(pooled<double>(runs, &RunMeasurement::tracking_around_loops_ms));
  const auto tracking = [&](double StageStatistics::*member) {
    return describe(over_runs(runs, [&](const auto& r) { return r.tracking.*member; })).median;
  };
  const std::vector<PaperTimes> loops = pooled<PaperTimes>(runs, &RunMeasurement::loops);
  Json j{{"runs", runs.size()},
         {"loops", first.loops.size()},
         {"merges", first.merges_ms.size()},
         {"same_every_run", same},
         {"keyframes", first.keyframes},
         {"columns_ms", loops.empty() ? Json() : columns_json(loops)},
         {"merge_ms", statistics_or_null(pooled<double>(runs, &RunMeasurement::merges_ms))}};
  j["ate_m"] = has_truth ? to_json(describe(over_runs(runs, [](const auto& r) { return r.ate_m; })))
                         : Json();
  j["coverage_percent"] = has_truth ? Json(100 * first.coverage) : Json();
  j["tracking_around_loops_ms"] =
      around.count ? tracking_json(around.count, around.p50_ms, around.p99_ms, around.max_ms)
                   : Json();
  j["tracking_ms"] =
      tracking_json(first.tracking.count, tracking(&StageStatistics::p50_ms),
                    tracking(&StageStatistics::p99_ms), tracking(&StageStatistics::max_ms));
  j["host_peak_mib"] = to_json(describe(over_runs(runs, [](const auto& r) { return r.peak_mib; })));
  j["device_peak_mib"] = device_json(runs, &RunMeasurement::device_peak_mib);
  j["device_transfers_mib"] = device_json(runs, &RunMeasurement::device_transfers_mib);
  return j;
}

Json comparison_json(const Json& base, const Json& other) {
  Json j;
  j["same_loops"] = base["loops"] == other["loops"] && base["merges"] == other["merges"];
  Json speed_up;
  if (!base["columns_ms"].is_null() && !other["columns_ms"].is_null())
    for (const PaperColumn& c : paper_columns())
      speed_up[c.key] = base["columns_ms"][c.key]["median"].get<double>() /
                        other["columns_ms"][c.key]["median"].get<double>();
  j["speed_up"] = speed_up;
  if (base["ate_m"].is_null() || other["ate_m"].is_null()) return j;
  const double a = base["ate_m"]["median"], b = other["ate_m"]["median"];
  j["ate_difference_m"] = b - a;
  j["accuracy_kept"] = b - a <= std::max(kKeptRelative * a, kKeptM);
  return j;
}

Json row_json(const SequenceResult& r, const std::vector<std::string>& backends) {
  Json j{{"name", r.row.name}, {"group", r.row.group}, {"paper", r.row.paper}};
  if (!r.missing.empty()) {
    j["missing"] = r.missing;
    return j;
  }
  const RunMeasurement& first = r.runs.front().front();
  j["kind"] = to_string(r.kind);
  j["data"] = r.data;
  j["frames"] = first.frames;
  j["path_length_m"] = first.path_length_m;
  j["ground_truth"] = r.ground_truth.empty() ? Json() : Json(r.ground_truth);
  for (std::size_t b = 0; b < backends.size(); ++b)
    j["backends"][backends[b]] = backend_json(r.runs[b], !r.ground_truth.empty());
  for (std::size_t b = 1; b < backends.size(); ++b)
    j["comparison"][backends[b]] =
        comparison_json(j["backends"][backends[0]], j["backends"][backends[b]]);
  j["warnings"] = r.warnings;
  return j;
}

}  // namespace

RunMeasurement measure(const RunFolder& run, const std::optional<Evaluation>& evaluation) {
  RunMeasurement m;
  for (const RunLoop& loop : run.applied(false)) m.loops.push_back(paper_times(loop.stages_ms));
  for (const RunLoop& loop : run.applied(true))
    m.merges_ms.push_back(paper_times(loop.stages_ms).total());
  m.tracking_around_loops_ms = run.tracking_around_loops_ms();
  m.tracking = summarize(run.timing.at("track_by_frame").at("ms").get<std::vector<double>>());
  if (evaluation) {
    m.ate_m = evaluation->ate_m.rmse;
    m.coverage = evaluation->coverage;
    m.path_length_m = evaluation->path_length_m;
  }
  m.peak_mib = run.timing.at("memory").at("peak_mib").get<double>();
  if (const Json device = run.timing.value("device", Json()); !device.is_null()) {
    m.device_peak_mib = device.at("peak_mib").get<double>();
    m.device_transfers_mib =
        device.at("to_device_mib").get<double>() + device.at("to_host_mib").get<double>();
  }
  m.frames = run.summary.at("frames").get<std::size_t>();
  m.keyframes = run.summary.at("keyframes").get<std::size_t>();
  return m;
}

Json to_json(const SampleStatistics& s) {
  return {{"count", s.count},   {"mean", s.mean}, {"sd", s.sd},
          {"median", s.median}, {"min", s.min},   {"max", s.max}};
}

Json columns_json(const std::vector<PaperTimes>& loops) {
  Json j;
  const auto column = [&](auto value) {
    std::vector<double> values;
    for (const PaperTimes& t : loops) values.push_back(value(t));
    return to_json(describe(std::move(values)));
  };
  for (const PaperColumn& c : paper_columns()) j[c.key] = column(c.value);
  j["not_published"] = column([](const PaperTimes& t) { return t.not_published; });
  return j;
}

Json to_json(const BenchInfo& info, const std::string& kind) {
  const io::MachineFacts& m = info.machine;
  return {{"kind", kind},
          {"date", info.date},
          {"commit", m.commit},
          {"command", info.command},
          {"machine",
           {{"cpu", m.cpu},
            {"cores", m.cores},
            {"memory_gib", m.memory_gib},
            {"compiler", m.compiler},
            {"build", m.build}}},
          {"runs", info.runs},
          {"warm_up", info.warm_up},
          {"backends", info.backends}};
}

Json loop_table_json(const BenchInfo& info, const std::vector<SequenceResult>& results) {
  Json table = to_json(info, "bench loops");
  table["alignment"] = "se3";
  table["accuracy_kept_when"] = {{"relative", kKeptRelative}, {"or_m", kKeptM}};
  table["sequences"] = Json::array();
  for (const SequenceResult& r : results) table["sequences"].push_back(row_json(r, info.backends));
  return table;
}

std::string three_digits(double value) {
  const double size = std::abs(value);
  char text[40];
  std::snprintf(text, sizeof text, size >= 99.95 ? "%.0f" : size >= 9.995 ? "%.1f" : "%.2f", value);
  return text;
}

std::string mean_and_sd(const Json& s) {
  const double mean = s["mean"], sd = s["sd"];
  const int decimals = std::abs(mean) >= 99.95 ? 0 : std::abs(mean) >= 9.995 ? 1 : 2;
  char text[80];
  std::snprintf(text, sizeof text, "%.*f ± %.*f", decimals, mean, decimals, sd);
  return text;
}

}  // namespace fastloop::eval
