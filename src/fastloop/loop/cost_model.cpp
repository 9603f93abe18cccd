#include "fastloop/loop/cost_model.hpp"

#include <tbb/info.h>

#include <cstdlib>
#include <fstream>
#include <nlohmann/json.hpp>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/core/logging.hpp"

namespace fastloop::loop {
namespace {

using Json = nlohmann::ordered_json;
namespace fs = std::filesystem;

constexpr int kVersion = 1;

Json cost_json(const StepCost& c) {
  return {{"fixed_us", c.fixed_us}, {"unit_ns", c.unit_ns}};
}

StepCost parse_cost(const Json& j) {
  StepCost c{j.at("fixed_us").get<double>(), j.at("unit_ns").get<double>()};
  if (!(c.fixed_us >= 0 && c.fixed_us < 1e9 && c.unit_ns >= 0 && c.unit_ns < 1e9))
    throw InvalidArgument("a cost is negative or no number");
  return c;
}

std::string cpu_name() {
  std::ifstream in("/proc/cpuinfo");
  for (std::string line; std::getline(in, line);)
    if (const auto colon = line.find(": "); line.starts_with("model name") && colon != line.npos)
      return line.substr(colon + 2);
  return "unknown";
}

}  // namespace

const char* to_string(Step step) {
  switch (step) {
    case Step::kSimilarity:
      return "similarity";
    case Step::kDescriptors:
      return "descriptors";
    case Step::kProjection:
      return "projection";
    case Step::kPoseGraph:
      return "pose_graph";
  }
  return "unknown";
}

CostModel CostModel::defaults(int threads) {
  // Pieces of work this small spread badly: 16 threads are five times as fast as one. The graph
  // gains nothing from more than one.
  const double speed_up = 1 + 0.3 * (std::max(threads, 1) - 1);
  CostModel m;
  m.of(Step::kSimilarity) = {{3, 16 / speed_up}, {20, 0.04}};
  m.of(Step::kDescriptors) = {{25, 38 / speed_up}, {40, 4.5}};
  m.of(Step::kProjection) = {{25, 25 / speed_up}, {33, 1.9}};
  m.of(Step::kPoseGraph) = {{200, 1000}, {700, 270}};
  return m;
}

CostModelMachine this_machine() {
  CostModelMachine m;
  m.cpu = cpu_name();
  m.threads = tbb::info::default_concurrency();
  const CudaInventory cuda = cuda_inventory();
  if (!cuda.devices.empty()) m.device = cuda.devices.front().name;
  return m;
}

fs::path cost_model_file() {
  const char* cache = std::getenv("XDG_CACHE_HOME");
  if (cache && *cache) return fs::path(cache) / "fastloop" / "cost_model.json";
  const char* home = std::getenv("HOME");
  if (home && *home) return fs::path(home) / ".cache" / "fastloop" / "cost_model.json";
  return {};
}

void save_cost_model(const fs::path& file, const CostModel& model,
                     const CostModelMachine& machine) {
  Json j{{"version", kVersion},
         {"cpu", machine.cpu},
         {"threads", machine.threads},
         {"device", machine.device}};
  for (int s = 0; s < kNumSteps; ++s) {
    const auto& costs = model.of(static_cast<Step>(s));
    j["steps"][to_string(static_cast<Step>(s))] = {{"cpu", cost_json(costs.cpu)},
                                                   {"device", cost_json(costs.device)}};
  }
  std::error_code ignored;
  fs::create_directories(file.parent_path(), ignored);
  std::ofstream out(file);
  out << j.dump(2) << "\n";
  out.close();
  if (!out) throw InputError({file.string(), 0, ""}, "the cost model cannot be written");
}

CostModel load_cost_model(const fs::path& file, const CostModelMachine& machine,
                          std::string* source) {
  const auto say = [&](const std::string& text) {
    if (source) *source = text;
  };
  const CostModel defaults = CostModel::defaults(machine.threads);
  say("defaults");
  std::error_code ignored;
  if (file.empty() || !fs::exists(file, ignored)) return defaults;
  try {
    std::ifstream in(file);
    const Json j = Json::parse(in);
    if (j.at("version").get<int>() != kVersion) throw InvalidArgument("it has another version");
    const CostModelMachine of{j.at("cpu").get<std::string>(), j.at("device").get<std::string>(),
                              j.at("threads").get<int>()};
    if (of != machine) throw InvalidArgument("it was measured on another machine");
    CostModel model;
    for (int s = 0; s < kNumSteps; ++s) {
      const Json& costs = j.at("steps").at(to_string(static_cast<Step>(s)));
      model.of(static_cast<Step>(s)) = {parse_cost(costs.at("cpu")),
                                        parse_cost(costs.at("device"))};
    }
    say(file.string());
    return model;
  } catch (const std::exception& e) {
    logger("loop").warn("{}: {}; default costs are used (fastloop doctor --calibrate measures)",
                        file.string(), e.what());
    return defaults;
  }
}

const CostModel& cost_model() {
  static const CostModel model = load_cost_model(cost_model_file(), this_machine());
  return model;
}

}  // namespace fastloop::loop
