#include <algorithm>
#include <cstdio>
#include <iostream>
#include <memory>

#include "bench_command.hpp"
#include "bench_support.hpp"
#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/eval/replay_table.hpp"
#include "fastloop/io/run_output.hpp"

namespace fastloop::apps {
namespace {

namespace fs = std::filesystem;

struct Arguments {
  std::vector<std::string> paths, backends{"reference", "cpu"};
  std::string out;
  int runs = 5, warm_up = 1;
};

struct MapFile {
  fs::path path;
  std::string name;  ///< below the folder it was found in
};

/// Map files, and those in folders, in the order of their names.
std::vector<MapFile> map_files(const std::vector<std::string>& paths) {
  std::vector<MapFile> files;
  for (const fs::path path : paths) {
    if (!fs::is_directory(path)) {
      files.push_back({path, path.stem().string()});
      continue;
    }
    std::vector<fs::path> found;
    for (const auto& entry : fs::recursive_directory_iterator(path))
      if (entry.path().extension() == ".flmap") found.push_back(entry.path());
    if (found.empty())
      throw InputError({path.string(), 0, ""}, "no map files (*.flmap) in this folder",
                       "a folder of fastloop run --record-loops");
    std::sort(found.begin(), found.end());
    for (const fs::path& file : found)
      files.push_back({file, fs::relative(file, path).replace_extension().string()});
  }
  return files;
}

int bench(const Arguments& a) {
  eval::ReplayPlan plan;
  plan.backends = parse_backends(a.backends);
  plan.left_out.assign(plan.backends.size(), false);
  plan.runs = a.runs;
  plan.warm_up = a.warm_up;
  const auto files = map_files(a.paths);
  if (!a.out.empty()) io::prepare_output_folder(a.out);
  const eval::BenchInfo info = bench_info(command_line(), plan.backends, a.runs, a.warm_up);
  std::vector<eval::ReplayCase> cases;
  for (const auto& [file, name] : files) {
    const map::LoadedMap loaded = map::read_map_file(file);
    cases.push_back(
        eval::measure_replay(name, loaded.map.publish(), loop::request_of(loaded, file), plan));
    std::fprintf(stderr, "bench: %s: %s\n", name.c_str(), cases.back().verdict.c_str());
  }
  const eval::Json table = eval::replay_table_json(info, "bench replay", cases);
  const std::string markdown = eval::replay_table_markdown(table);
  if (!a.out.empty())
    write_results(a.out, "replay", table, markdown, eval::replay_table_csv(table));
  std::cout << markdown;
  return kExitOk;
}

}  // namespace

void add_bench_replay(CLI::App& bench_app, int& exit_code) {
  auto a = std::make_shared<Arguments>();
  CLI::App* command =
      bench_app.add_subcommand("replay", "Recorded loops closed again, stage by stage");
  command->add_option("PATH", a->paths, "Map files with a pending loop, or folders of them")
      ->required();
  command->add_option("--out", a->out, "Folder for replay.json, replay.md and replay.csv");
  command->add_option("--runs", a->runs, "Measured repetitions of each back end")
      ->check(CLI::Range(1, 100000))
      ->capture_default_str();
  command->add_option("--warm-up", a->warm_up, "Repetitions before, not measured")
      ->check(CLI::Range(0, 1000))
      ->capture_default_str();
  command
      ->add_option(
          "--backends", a->backends,
          "Back ends: reference, cpu, cuda, auto; the first is what the others are compared with")
      ->delimiter(',')
      ->capture_default_str();
  command->footer(
      "Example: fastloop run V1_03 --out out/v103 --record-loops out/v103/maps && fastloop bench "
      "replay "
      "out/v103/maps");
  command->callback([a, &exit_code] { exit_code = bench(*a); });
}

}  // namespace fastloop::apps
