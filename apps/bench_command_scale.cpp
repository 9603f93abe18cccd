#include <malloc.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <memory>

#include "bench_command.hpp"
#include "bench_support.hpp"
#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/eval/replay_table.hpp"
#include "fastloop/io/run_output.hpp"
#include "fastloop/io/text.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/sim/map_worlds.hpp"

namespace fastloop::apps {
namespace {

struct Arguments {
  std::string keyframes = "100..10000", out;
  std::vector<std::string> backends{"reference", "cpu"};
  int runs = 5, warm_up = 1, reference_max = 3000;
  sim::MapWorldOptions world;
};

int parse_size(const std::string& text) {
  const auto value = io::parse_number(text);
  if (!value || *value < 60 || *value > 1e6 || *value != std::floor(*value))
    throw InvalidArgument("--keyframes: '" + text +
                          "' is not a number of keyframes from 60 to 1000000");
  return static_cast<int>(*value);
}

/// "100..10000" is 100, 300, 1000, 3000, 10000: the ends and what is 1 or 3 times a power of ten
/// between them. "100,500,2000" is what it says.
std::vector<int> parse_sizes(const std::string& text) {
  std::vector<int> sizes;
  if (const auto dots = text.find(".."); dots != std::string::npos) {
    const int low = parse_size(text.substr(0, dots)), high = parse_size(text.substr(dots + 2));
    if (low > high) throw InvalidArgument("--keyframes: the range is empty");
    sizes = {low, high};
    for (int power = 10; power <= 1000000; power *= 10)
      for (const int size : {power, 3 * power})
        if (size > low && size < high) sizes.push_back(size);
  } else {
    for (std::size_t at = 0; at <= text.size();) {
      const std::size_t comma = std::min(text.find(',', at), text.size());
      sizes.push_back(parse_size(text.substr(at, comma - at)));
      at = comma + 1;
    }
  }
  std::sort(sizes.begin(), sizes.end());
  sizes.erase(std::unique(sizes.begin(), sizes.end()), sizes.end());
  return sizes;
}

/// What the program holds of the heap; what was freed and kept for later does not count.
double heap_mib() {
  const struct mallinfo2 heap = mallinfo2();
  return static_cast<double>(heap.uordblks + heap.hblkhd) / (1 << 20);
}

eval::ReplayCase measure_size(int size, const Arguments& a, eval::ReplayPlan plan) {
  sim::MapWorldOptions world = a.world;
  world.keyframes = size;
  const double before_mib = heap_mib();
  const sim::SimulatedMap simulated = sim::simulate_map(world);
  // What the simulator needed to know of the world is in here, too; a few bytes of a keypoint.
  const double map_mib = heap_mib() - before_mib;
  loop::LoopRequest request;
  request.keyframe = simulated.current;
  request.inertial = world.inertial;
  for (std::size_t b = 0; b < plan.backends.size(); ++b)
    plan.left_out[b] = plan.backends[b] == loop::Backend::kReference && size > a.reference_max;
  eval::ReplayCase c =
      eval::measure_replay(std::to_string(size), simulated.map.publish(), request, plan);
  c.map_mib = std::max(0.0, map_mib);
  if (std::find(plan.left_out.begin(), plan.left_out.end(), true) != plan.left_out.end())
    c.notes.push_back("reference left out: larger than --reference-max " +
                      std::to_string(a.reference_max));
  return c;
}

int bench(const Arguments& a) {
  eval::ReplayPlan plan;
  plan.backends = parse_backends(a.backends);
  plan.left_out.assign(plan.backends.size(), false);
  plan.runs = a.runs;
  plan.warm_up = a.warm_up;
  const std::vector<int> sizes = parse_sizes(a.keyframes);
  io::prepare_output_folder(a.out);
  const eval::BenchInfo info = bench_info(command_line(), plan.backends, a.runs, a.warm_up);
  std::vector<eval::ReplayCase> cases;
  std::string markdown;
  place::default_vocabulary();  // is loaded once, and belongs to no map
  for (const int size : sizes) {
    cases.push_back(measure_size(size, a, plan));
    const eval::ReplayCase& c = cases.back();
    std::fprintf(stderr, "bench: %d keyframes: %s, %zu poses, %zu edges\n", size, c.verdict.c_str(),
                 c.poses, c.edges);
    const eval::Json table = eval::replay_table_json(info, "bench scale", cases);
    markdown = eval::replay_table_markdown(table);
    write_results(a.out, "scale", table, markdown, eval::replay_table_csv(table));
    if (const std::string svg = eval::speed_up_svg(table); !svg.empty())
      io::write_text_file(std::filesystem::path(a.out) / "speed_up.svg", svg);
  }
  std::cout << markdown;
  return kExitOk;
}

}  // namespace

void add_bench_scale(CLI::App& bench_app, int& exit_code) {
  auto a = std::make_shared<Arguments>();
  CLI::App* command = bench_app.add_subcommand(
      "scale", "Each stage of loop closing against the size of a simulated map");
  command
      ->add_option(
          "--keyframes", a->keyframes,
          "Sizes: LOW..HIGH (1 and 3 times the powers of ten between them) or a list A,B,C")
      ->capture_default_str();
  command
      ->add_option("--out", a->out, "Folder for scale.json, scale.md, scale.csv and speed_up.svg")
      ->required();
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
  command
      ->add_option("--reference-max", a->reference_max,
                   "Largest map for the back end reference, which takes very long on large ones")
      ->capture_default_str();
  command->add_option("--features", a->world.features, "Keypoints of a keyframe")
      ->check(CLI::Range(50, 20000))
      ->capture_default_str();
  command
      ->add_option("--covisible", a->world.covisible,
                   "Keyframes that share landmarks with one, about")
      ->check(CLI::Range(8, 400))
      ->capture_default_str();
  command->add_option("--seed", a->world.seed, "World, drift and noise follow from it")
      ->capture_default_str();
  command->add_flag("--inertial", a->world.inertial, "As with an initialised IMU: 4-DoF graphs");
  command->footer(
      "Example: fastloop bench scale --keyframes 100..100000 --inertial --out out/scale");
  command->callback([a, &exit_code] { exit_code = bench(*a); });
}

}  // namespace fastloop::apps
