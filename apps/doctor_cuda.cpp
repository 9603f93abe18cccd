#include "doctor_cuda.hpp"

#include <cstdio>
#include <string>

#include "calibration.hpp"
#include "fastloop/compute/cuda_session.hpp"

namespace fastloop::apps {
namespace {

using loop::CostModel;
using loop::Step;

void print_row(const char* name, const std::string& value) {
  std::printf("%-14s %s\n", name, value.c_str());
}

std::string gibibytes(std::size_t bytes) {
  char text[32];
  std::snprintf(text, sizeof text, "%.1f GiB", static_cast<double>(bytes) / (1 << 30));
  return text;
}

/// A step with a typical amount of work for a map of a given size.
struct TypicalWork {
  const char* what;
  Step step;
  double work(int keyframes) const { return per_loop + per_keyframe * keyframes; }
  double per_loop, per_keyframe;
};

/// Six candidates of 150 pairs, which mostly decide within 20 hypotheses; 33 keyframes with 1,000
/// keypoints; 3,000 landmarks in one keyframe and in 20; graphs without gravity.
constexpr TypicalWork kTypical[] = {{"similarity", Step::kSimilarity, 6 * 150 * 20, 0},
                                    {"descriptors", Step::kDescriptors, 33 * 1000, 0},
                                    {"searches", Step::kProjection, 3000, 0},
                                    {"fusion", Step::kProjection, 20 * 3000, 0},
                                    {"pose graph", Step::kPoseGraph, 0, 6}};

void print_choices(const CostModel& costs, const std::string& source) {
  print_row("costs", source);
  for (const int keyframes : {300, 1000, 10000}) {
    std::string choice = std::to_string(keyframes) + " keyframes:";
    for (const TypicalWork& t : kTypical)
      choice += std::string(" ") + t.what + " " +
                (costs.device_wins(t.step, t.work(keyframes)) ? "cuda" : "cpu") + ",";
    choice.back() = ' ';
    print_row("auto", choice);
  }
}

void print_costs(const CostModel& costs) {
  for (int s = 0; s < loop::kNumSteps; ++s) {
    const auto& c = costs.of(static_cast<Step>(s));
    std::printf("%-14s cpu %8.1f us + %9.3f ns, cuda %8.1f us + %9.3f ns a unit\n",
                loop::to_string(static_cast<Step>(s)), c.cpu.fixed_us, c.cpu.unit_ns,
                c.device.fixed_us, c.device.unit_ns);
  }
}

}  // namespace

void print_cuda() {
  const CudaInventory cuda = cuda_inventory();
  if (!cuda.compiled_in) {
    print_row("CUDA", "not compiled in");
    print_row("auto", "cpu");
    return;
  }
  print_row("CUDA", "runtime " + cuda.runtime_version + ", driver " +
                        (cuda.driver_version.empty() ? "none" : cuda.driver_version));
  if (cuda.devices.empty()) {
    print_row("device", "none: " + cuda.reason);
    print_row("auto", "cpu");
    return;
  }
  for (const CudaDeviceInfo& d : cuda.devices)
    print_row(("device " + std::to_string(d.index)).c_str(),
              d.name + ", compute capability " + std::to_string(d.compute_major) + "." +
                  std::to_string(d.compute_minor) + ", " + std::to_string(d.multiprocessors) +
                  " multiprocessors, " + gibibytes(d.memory_bytes));
  std::string source;
  const CostModel costs =
      loop::load_cost_model(loop::cost_model_file(), loop::this_machine(), &source);
  print_choices(costs, source);
}

void calibrate_costs() {
  const auto session = CudaSession::process_wide();
  if (!session) {
    print_row("calibration", "needs a device: there is nothing to choose between");
    return;
  }
  const CostModel costs = measure_costs(Executor::cpu(), Executor::cuda(session));
  print_costs(costs);
  const std::filesystem::path file = loop::cost_model_file();
  if (file.empty()) {
    print_row("calibration", "not stored: neither XDG_CACHE_HOME nor HOME is set");
    return;
  }
  loop::save_cost_model(file, costs, loop::this_machine());
  print_row("calibration", "stored in " + file.string());
}

}  // namespace fastloop::apps
