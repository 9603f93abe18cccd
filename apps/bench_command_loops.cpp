#include <cstdio>
#include <iostream>
#include <memory>
#include <optional>

#include "bench_command.hpp"
#include "bench_support.hpp"
#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/eval/evaluation.hpp"
#include "fastloop/io/run_output.hpp"
#include "fastloop/io/text.hpp"
#include "sequences_yaml.hpp"

namespace fastloop::apps {
namespace {

namespace fs = std::filesystem;

struct Arguments {
  std::vector<std::string> datasets{"all"};
  std::vector<std::string> roots, backends{"reference", "cpu"};
  std::string out, sequences, mode, config;
  int runs = 5, warm_up = 1;
  std::size_t max_frames = 0;
  bool simulate = true;
};

/// A row with the folder its images are in.
struct Job {
  eval::SequenceRow row;
  eval::SequenceKind kind = eval::SequenceKind::kUnknown;
  fs::path folder;
  std::string missing;
};

Job job_of(const eval::SequenceRow& row, const std::vector<fs::path>& roots, const Arguments& a) {
  Job job{row, eval::SequenceKind::kUnknown, {}, {}};
  const auto found = eval::locate(row, roots);
  if (!found) {
    job.missing = "no folder of it under --root";
    return job;
  }
  job.kind = found->kind;
  job.folder = found->folder;
  if (!job.folder.empty()) return job;
  if (!a.simulate) {
    job.missing = "not simulated yet, and --no-simulate was given";
    return job;
  }
  job.folder = fs::path(a.out) / "data" / row.name;
  if (fs::is_directory(job.folder)) return job;
  std::fprintf(stderr, "bench: simulating %s\n", row.name.c_str());
  // Under another name until it is complete, so that an interrupted one is not taken for whole.
  const fs::path part = job.folder.string() + ".part";
  fs::remove_all(part);
  fs::create_directories(part.parent_path());
  std::vector<std::string> words{"simulate", found->simulate->world, "--out", part.string()};
  if (!found->simulate->camera.empty())
    words.insert(words.end(), {"--camera", found->simulate->camera});
  if (found->simulate->seconds > 0)
    words.insert(words.end(), {"--seconds", std::to_string(found->simulate->seconds)});
  const fs::path log = job.folder.string() + ".log";
  if (run_again(words, log) != kExitOk) throw Error("simulating failed, see " + log.string());
  fs::rename(part, job.folder);
  return job;
}

std::vector<Job> jobs_of(const Arguments& a) {
  const auto rows = a.sequences.empty()
                        ? eval::parse_sequences(kSequencesYaml, "eval/sequences.yaml")
                        : eval::parse_sequences(io::read_text_file(a.sequences), a.sequences);
  const std::vector<fs::path> roots(a.roots.begin(), a.roots.end());
  std::vector<Job> jobs;
  for (const std::string& name : a.datasets) {
    bool known = false;
    for (const eval::SequenceRow& row : rows) {
      const bool wanted =
          name == row.name || name == row.group || name == "all" || (name == "paper" && row.paper);
      known |= wanted;
      if (wanted) jobs.push_back(job_of(row, roots, a));
    }
    if (known) continue;
    if (!fs::is_directory(name))
      throw InvalidArgument(
          "'" + name +
          "' is neither a folder nor a row, a group, 'paper' or 'all' of the list of sequences");
    const eval::NamedFolder named = eval::classify(name, rows);
    jobs.push_back({named.row, named.kind, name, {}});
  }
  return jobs;
}

std::optional<eval::Evaluation> evaluate(const eval::RunFolder& run) {
  const eval::Json& truth = run.summary.at("ground_truth");
  if (truth.is_null() || run.final_poses.size() < 3) return std::nullopt;
  const auto reference = io::read_trajectory(truth.get<std::string>());
  return eval::evaluate(reference.poses, run.final_poses, {});
}

/// Runs SLAM once and measures what it left.
/// @param maps  folder for the map just before each loop; empty: not kept
eval::RunMeasurement run_once(const Job& job, const std::string& backend, const fs::path& out,
                              const fs::path& maps, const Arguments& a,
                              eval::SequenceResult& result) {
  std::vector<std::string> words{"run",
                                 job.folder.string(),
                                 "--out",
                                 out.string(),
                                 "--backend",
                                 backend,
                                 "--quiet",
                                 "--mode",
                                 a.mode.empty() ? job.row.mode : a.mode};
  if (a.max_frames) words.insert(words.end(), {"--max-frames", std::to_string(a.max_frames)});
  if (!maps.empty()) words.insert(words.end(), {"--record-loops", maps.string()});
  if (!a.config.empty()) words.insert(words.end(), {"--config", a.config});
  fs::create_directories(out);
  const fs::path log = out / "run.log";
  const int code = run_again(words, log);
  if (code != kExitOk)
    throw Error("fastloop run ended with " + std::to_string(code) + ", see " + log.string());
  const eval::RunFolder run = eval::read_run_folder(out);
  const auto warn = [&](const std::string& text) {
    for (const std::string& known : result.warnings)
      if (known == text) return;
    std::fprintf(stderr, "bench: warning: %s, %s: %s\n", job.row.name.c_str(), backend.c_str(),
                 text.c_str());
    result.warnings.push_back(text);
  };
  if (const auto mismatch = eval::check_stage_sums(run)) warn(backend + ": " + *mismatch);
  for (const eval::RunLoop& loop : run.loops)
    for (const std::string& stage : eval::paper_times(loop.stages_ms).unknown)
      warn("the stage '" + stage + "' belongs to no column of the table");
  const auto evaluation = evaluate(run);
  if (!run.summary.at("ground_truth").is_null())
    result.ground_truth =
        fs::path(run.summary.at("ground_truth").get<std::string>()).filename().string();
  return eval::measure(run, evaluation);
}

eval::SequenceResult measure_sequence(const Job& job, const eval::BenchInfo& info,
                                      const Arguments& a) {
  eval::SequenceResult result;
  result.row = job.row;
  result.kind = job.kind;
  result.missing = job.missing;
  result.data = job.folder.filename().string();
  if (!job.missing.empty()) return result;
  result.runs.resize(info.backends.size());
  // Back ends take turns, so that what else the machine does hits all of them alike.
  for (int round = -a.warm_up; round < a.runs; ++round) {
    for (std::size_t b = 0; b < info.backends.size(); ++b) {
      const std::string name = round < 0 ? "warm_up" : "run" + std::to_string(round + 1);
      const fs::path out = fs::path(a.out) / "runs" / job.row.name / info.backends[b] / name;
      // The loops of an unmeasured run are kept for `bench replay`; writing them takes time.
      const bool keep = round == -1 && b + 1 == info.backends.size();
      const fs::path maps = keep ? fs::path(a.out) / "maps" / job.row.name : fs::path();
      const eval::RunMeasurement m = run_once(job, info.backends[b], out, maps, a, result);
      std::fprintf(stderr, "bench: %s, %s, %s: %zu loops, ATE %.4f m\n", job.row.name.c_str(),
                   info.backends[b].c_str(), name.c_str(), m.loops.size(), m.ate_m);
      if (round < 0)
        fs::remove_all(out);
      else
        result.runs[b].push_back(m);
    }
  }
  return result;
}

int bench(const Arguments& a) {
  const auto backends = parse_backends(a.backends);
  io::prepare_output_folder(a.out);
  const eval::BenchInfo info = bench_info(command_line(), backends, a.runs, a.warm_up);
  std::vector<eval::SequenceResult> results;
  eval::Json table;
  for (const Job& job : jobs_of(a)) {
    try {
      results.push_back(measure_sequence(job, info, a));
    } catch (const Error& e) {
      // One sequence that cannot be run does not take the others along.
      std::fprintf(stderr, "bench: %s: %s\n", job.row.name.c_str(), e.what());
      eval::SequenceResult failed;
      failed.row = job.row;
      failed.missing = e.what();
      results.push_back(failed);
    }
    // Written after each sequence: a long bench that is stopped leaves what it has.
    table = eval::loop_table_json(info, results);
    write_results(a.out, "loops", table, eval::loop_table_markdown(table),
                  eval::loop_table_csv(table));
  }
  std::cout << eval::loop_table_markdown(table);
  return kExitOk;
}

}  // namespace

void add_bench_loops(CLI::App& bench_app, int& exit_code) {
  auto a = std::make_shared<Arguments>();
  CLI::App* command = bench_app.add_subcommand(
      "loops", "The table of loop closing: SLAM on sequences, with each back end, several times");
  command
      ->add_option("--dataset", a->datasets,
                   "Folders, rows or groups of the list of sequences, 'paper' (the rows of the "
                   "FastLoop paper) or 'all'")
      ->delimiter(',')
      ->capture_default_str();
  command->add_option("--root", a->roots, "Folders below which the rows' sequences are looked for")
      ->delimiter(',');
  command->add_option("--out", a->out, "Folder for the tables and the runs")->required();
  command->add_option("--runs", a->runs, "Measured runs of each back end")
      ->check(CLI::Range(1, 1000))
      ->capture_default_str();
  command->add_option("--warm-up", a->warm_up, "Runs of each back end before, not measured")
      ->check(CLI::Range(0, 100))
      ->capture_default_str();
  command
      ->add_option(
          "--backends", a->backends,
          "Back ends: reference, cpu, cuda, auto; the first is what the others are compared with")
      ->delimiter(',')
      ->capture_default_str();
  command->add_option("--sequences", a->sequences,
                      "List of sequences that replaces the program's own (eval/sequences.yaml)");
  command->add_option("--mode", a->mode, "Sensors, as for run; default: what the row says");
  command->add_option("--config", a->config, "YAML with options, as for run");
  command->add_option("--max-frames", a->max_frames, "Only the beginning of each; 0 = all")
      ->capture_default_str();
  command->add_flag("!--no-simulate", a->simulate,
                    "Leave out simulated rows that are not there, instead of making them");
  command->footer(
      "Writes loops.json, loops.md and loops.csv, every run below runs/, and the loops below maps/ "
      "for\n"
      "bench replay. The columns are those of the FastLoop paper; "
      "src/fastloop/eval/loop_stages.cpp says\n"
      "which stage belongs to which.\n"
      "Example: fastloop bench loops --dataset paper --root /data --out out/bench");
  command->callback([a, &exit_code] { exit_code = bench(*a); });
}

}  // namespace fastloop::apps
