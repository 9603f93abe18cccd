#include <cstdio>
#include <filesystem>
#include <iostream>
#include <memory>

#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/eval/html_report.hpp"
#include "fastloop/io/dataset.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::apps {
namespace {

namespace fs = std::filesystem;

struct Arguments {
  std::string run, out, ground_truth;
  std::vector<std::string> benches;
};

/// The file given, or that of the data set given, or the one the run knew, if it is still there.
std::string ground_truth_file(const Arguments& a, const eval::RunFolder& run) {
  if (!a.ground_truth.empty()) {
    if (!fs::is_directory(a.ground_truth)) return a.ground_truth;
    const auto truth = io::open_dataset(a.ground_truth)->ground_truth();
    if (!truth) throw InputError({a.ground_truth, 0, ""}, "this data set has no ground truth");
    return truth->string();
  }
  const eval::Json known = run.summary.value("ground_truth", eval::Json());
  if (known.is_null()) return "";
  const std::string file = known.get<std::string>();
  if (fs::exists(file)) return file;
  std::fprintf(stderr, "fastloop: %s is not there any more: no errors in the report\n",
               file.c_str());
  return "";
}

eval::Json read_bench(const std::string& file) {
  try {
    eval::Json j = eval::Json::parse(io::read_text_file(file));
    if (j.value("kind", "").starts_with("bench ")) return j;
  } catch (const eval::Json::exception&) {
  }
  throw InputError({file, 0, ""}, "not a result of fastloop bench",
                   "loops.json, replay.json or scale.json");
}

int report(const Arguments& a) {
  eval::ReportInput input;
  input.run = eval::read_run_folder(a.run);
  const std::string truth = ground_truth_file(a, input.run);
  if (!truth.empty()) {
    input.ground_truth = io::read_trajectory(truth);
    input.ground_truth_name = fs::path(truth).filename().string();
  }
  for (const std::string& file : a.benches) input.benches.push_back(read_bench(file));
  const fs::path out = a.out.empty() ? fs::path(a.run) / "report.html" : fs::path(a.out);
  io::write_text_file(out, eval::html_report(input));
  std::printf("%s\n", out.string().c_str());
  return kExitOk;
}

}  // namespace

void add_report_command(CLI::App& app, int& exit_code) {
  auto a = std::make_shared<Arguments>();
  CLI::App* command = app.add_subcommand(
      "report", "One page (HTML) about a run: paths, errors, loops, times, memory, machine");
  command->add_option("RUN", a->run, "Folder that fastloop run wrote")->required();
  command->add_option("--out", a->out, "File to write; default: report.html in RUN");
  command->add_option("--ground-truth", a->ground_truth,
                      "Trajectory file, or data set folder; default: that of the run's data set");
  command
      ->add_option("--bench", a->benches,
                   "Results to show beside: loops.json, replay.json, scale.json of fastloop bench")
      ->delimiter(',');
  command->footer(
      "The page holds everything, pictures included, and fetches nothing.\n"
      "Example: fastloop report out/v103 --bench out/scale/scale.json --out v103.html");
  command->callback([a, &exit_code] { exit_code = report(*a); });
}

}  // namespace fastloop::apps
