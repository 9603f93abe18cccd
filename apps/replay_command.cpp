#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>

#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/loop/loop_replay.hpp"

namespace fastloop::apps {
namespace {

using Json = nlohmann::ordered_json;
using loop::ReplaySummary;

struct Arguments {
  std::vector<std::string> files;
  std::vector<std::string> backends{"auto"};
  int repeat = 5;
  bool json = false;
};

std::vector<loop::Backend> backends_of(const Arguments& a) {
  std::vector<loop::Backend> backends;
  for (const std::string& name : a.backends) {
    if (name != "all") {
      backends.push_back(loop::parse_backend(name));
      continue;
    }
    backends = {loop::Backend::kReference, loop::Backend::kCpu};
    if (loop::resolve(loop::Backend::kAuto) == loop::Backend::kAuto)
      backends.insert(backends.end(), {loop::Backend::kCuda, loop::Backend::kAuto});
  }
  return backends;
}

/// What a simulated map knows about its pending loop.
struct Truth {
  KeyframeId current, matched;
  SE3 T_matched_current;
};

std::optional<Truth> truth_of(const map::LoadedMap& loaded, const std::string& file) {
  const auto it = loaded.extras.find("truth");
  if (it == loaded.extras.end()) return std::nullopt;
  try {
    const Json j = Json::parse(it->second);
    Truth t;
    t.current = KeyframeId(j.at("keyframe").get<std::uint32_t>());
    t.matched = KeyframeId(j.at("expected_matches").at(0).get<std::uint32_t>());
    const auto p = j.at("T_matched_current").at("translation_m").get<std::array<double, 3>>();
    const auto q = j.at("T_matched_current").at("rotation_xyzw").get<std::array<double, 4>>();
    t.T_matched_current =
        SE3(Eigen::Quaterniond(q[3], q[0], q[1], q[2]), Vector3d(p[0], p[1], p[2]));
    if (loaded.map.contains(t.matched)) return t;
  } catch (const Json::exception&) {
  }
  throw InputError({file, 0, "truth"}, "not the truth of a pending loop");
}

Json truth_json(const Truth& truth, const map::Snapshot& map, const map::LoopEdge& edge) {
  // The loop may have been closed with a neighbour of the expected keyframe.
  const SE3 T_matched_current =
      map.T_world_body(truth.matched).inverse() * map.T_world_body(edge.a) * edge.T_a_b;
  return {{"translation_m",
           (T_matched_current.translation - truth.T_matched_current.translation).norm()},
          {"rotation_deg", angle_between(T_matched_current, truth.T_matched_current) * 180 / M_PI}};
}

Json candidate_json(const loop::CandidateReport& c) {
  Json gates = Json::array();
  for (const loop::GateReading& g : c.gates)
    gates.push_back(
        {{"gate", g.gate}, {"value", g.value}, {"threshold", g.threshold}, {"passed", g.passed}});
  return {{"keyframe", c.keyframe.value()},
          {"merge", c.merge},
          {"recheck", c.recheck},
          {"score", c.score},
          {"shared_words", c.shared_words},
          {"descriptor_matches", c.descriptor_matches},
          {"verdict", to_string(c.verdict)},
          {"reason", c.reason},
          {"gates", gates}};
}

std::string hex(std::uint64_t value) {
  char text[20];
  std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(value));
  return text;
}

Json summary_json(const ReplaySummary& s, const map::Snapshot& map,
                  const std::optional<Truth>& truth) {
  const loop::LoopReport& report = s.last.outcome.report;
  Json stages;
  for (const auto& [stage, ms] : s.stages_ms) stages[stage] = ms;
  Json candidates = Json::array();
  for (const loop::CandidateReport& c : report.candidates) candidates.push_back(candidate_json(c));
  Json j{{"backend", to_string(s.backend)},
         {"repeats", s.repeats},
         {"total_ms", s.total_ms},
         {"total_without_graph_ms", s.total_without_graph_ms},
         {"landmarks_and_covisibility_ms", s.landmarks_and_covisibility_ms},
         {"stages_ms", stages},
         {"verdict", to_string(report.verdict)},
         {"reason", report.reason},
         {"candidates", candidates},
         {"decision_digest", hex(decision_digest(s.last.outcome))},
         {"pose_digest", hex(pose_digest(s.last.outcome))}};
  if (const auto& c = s.last.outcome.correction) {
    j["correction"] = {{"applied", s.last.applied.applied},
                       {"reason", s.last.applied.reason},
                       {"matched", c->edge.a.value()},
                       {"moved_keyframes", s.last.applied.moved},
                       {"merged_landmarks", s.last.applied.merged},
                       {"new_observations", s.last.applied.observed}};
    if (truth) j["loop_edge_error"] = truth_json(*truth, map, c->edge);
  }
  return j;
}

Json file_json(const std::string& file, const Arguments& a) {
  const map::LoadedMap loaded = map::read_map_file(file);
  const loop::LoopRequest request = loop::request_of(loaded, file);
  const std::optional<Truth> truth = truth_of(loaded, file);
  const auto snapshot = loaded.map.publish();
  std::vector<loop::LoopReplay> replays;
  replays.reserve(a.backends.size() + 1);
  for (const loop::Backend backend : backends_of(a))
    replays.emplace_back(snapshot, request, backend);
  const std::vector<ReplaySummary> summaries = loop::repeat_replays(replays, a.repeat);

  Json j{{"file", file},
         {"keyframe", request.keyframe.value()},
         {"keyframes", snapshot->num_keyframes()},
         {"landmarks", snapshot->num_landmarks()},
         {"replays", Json::array()}};
  for (const ReplaySummary& s : summaries)
    j["replays"].push_back(summary_json(s, *snapshot, truth));
  if (summaries.size() < 2) return j;
  const ReplaySummary &first = summaries.front(), &last = summaries.back();
  j["comparison"] = {
      {"first", to_string(first.backend)},
      {"last", to_string(last.backend)},
      {"ratio", first.total_ms / last.total_ms},
      {"ratio_without_graph", first.total_without_graph_ms / last.total_without_graph_ms},
      {"decisions_equal",
       decision_digest(first.last.outcome) == decision_digest(last.last.outcome)},
      {"largest_pose_difference", largest_pose_difference(first.last.outcome, last.last.outcome)}};
  return j;
}

void print_replay(const Json& j) {
  const std::string backend = j["backend"];
  std::printf("\n%s: %s (%s), median of %d\n", backend.c_str(),
              j["verdict"].get<std::string>().c_str(), j["reason"].get<std::string>().c_str(),
              j["repeats"].get<int>());
  for (const Json& c : j["candidates"]) {
    std::printf("  candidate %u: %s%s%s\n", c["keyframe"].get<unsigned>(),
                c["verdict"].get<std::string>().c_str(), c["reason"].empty() ? "" : ", ",
                c["reason"].get<std::string>().c_str());
    for (const Json& g : c["gates"])
      std::printf("    %-34s %10.4g, threshold %10.4g %s\n", g["gate"].get<std::string>().c_str(),
                  g["value"].get<double>(), g["threshold"].get<double>(),
                  g["passed"].get<bool>() ? "" : "missed");
  }
  if (j.contains("correction")) {
    const Json& c = j["correction"];
    std::printf("  %s%s: %zu keyframes moved, %zu landmarks joined, %zu observations added\n",
                c["applied"].get<bool>() ? "applied" : "refused: ",
                c["reason"].get<std::string>().c_str(), c["moved_keyframes"].get<std::size_t>(),
                c["merged_landmarks"].get<std::size_t>(), c["new_observations"].get<std::size_t>());
  }
  if (j.contains("loop_edge_error"))
    std::printf("  error of the loop edge: %.4f m, %.3f degrees\n",
                j["loop_edge_error"]["translation_m"].get<double>(),
                j["loop_edge_error"]["rotation_deg"].get<double>());
  for (const auto& [stage, ms] : j["stages_ms"].items())
    std::printf("  %-28s %10.3f ms\n", stage.c_str(), ms.get<double>());
  std::printf("  %-28s %10.3f ms\n  %-28s %10.3f ms\n", "total", j["total_ms"].get<double>(),
              "without graph optimisation", j["total_without_graph_ms"].get<double>());
  std::printf("  digest of decisions %s, of poses %s\n",
              j["decision_digest"].get<std::string>().c_str(),
              j["pose_digest"].get<std::string>().c_str());
}

void print_file(const Json& j) {
  std::printf("%s: keyframe %u of a map of %zu keyframes, %zu landmarks\n",
              j["file"].get<std::string>().c_str(), j["keyframe"].get<unsigned>(),
              j["keyframes"].get<std::size_t>(), j["landmarks"].get<std::size_t>());
  for (const Json& replay : j["replays"]) print_replay(replay);
  if (!j.contains("comparison")) return;
  const Json& c = j["comparison"];
  std::printf("\n%s / %s: %.2f, without graph optimisation %.2f; decisions %s, poses within %.1e\n",
              c["first"].get<std::string>().c_str(), c["last"].get<std::string>().c_str(),
              c["ratio"].get<double>(), c["ratio_without_graph"].get<double>(),
              c["decisions_equal"].get<bool>() ? "equal" : "DIFFER",
              c["largest_pose_difference"].get<double>());
}

int run(const Arguments& a) {
  Json all = Json::array();
  for (const std::string& file : a.files) {
    all.push_back(file_json(file, a));
    if (!a.json) print_file(all.back());
  }
  if (a.json) std::cout << (all.size() == 1 ? all.front() : all).dump(2) << "\n";
  return kExitOk;
}

}  // namespace

void add_replay_command(CLI::App& app, int& exit_code) {
  auto a = std::make_shared<Arguments>();
  CLI::App* command = app.add_subcommand(
      "replay", "Close a recorded loop again: decisions, correction, times of each stage");
  command->footer(
      "Files come from fastloop run --record-loops or fastloop simulate-map. Back ends are "
      "repeated\n"
      "in turn, after one unmeasured repetition of each.\n"
      "Example: fastloop simulate-map --keyframes 1000 --out /tmp/m.flmap && "
      "fastloop replay /tmp/m.flmap --backend all");
  command->add_option("FILE", a->files, "Map files with a pending loop")->required();
  command
      ->add_option("--backend", a->backends,
                   "auto, reference, cpu, cuda; several, or all, are compared with each other")
      ->check(CLI::IsMember({"auto", "reference", "cpu", "cuda", "all"}))
      ->expected(1, 5)
      ->delimiter(',')
      ->capture_default_str();
  command->add_option("--repeat", a->repeat, "Measured repetitions; times are their medians")
      ->check(CLI::Range(1, 100000))
      ->capture_default_str();
  command->add_flag("--json", a->json, "Report as JSON; an array for several files");
  command->callback([a, &exit_code] { exit_code = run(*a); });
}

}  // namespace fastloop::apps
