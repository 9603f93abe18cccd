#pragma once

#include <array>
#include <filesystem>
#include <string>
#include <string_view>

/// When the device is worth the trip. What a step costs is a straight line in its amount of work,
/// on the CPU and on the device; docs/cuda.md says how the lines were found.
namespace fastloop::loop {

/// Steps of loop closing that have a device version, and the unit of their work.
enum class Step {
  kSimilarity,   ///< RANSAC: pairs x hypotheses
  kDescriptors,  ///< matching by vocabulary node: keypoints of the query x keyframes
  kProjection,   ///< searches and fusion: landmarks x keyframes
  kPoseGraph,    ///< unknowns of the graph
};
inline constexpr int kNumSteps = 4;
const char* to_string(Step step);

struct StepCost {
  double fixed_us = 0;  ///< whatever the amount of work
  double unit_ns = 0;   ///< of each unit
  double microseconds(double work) const { return fixed_us + 1e-3 * unit_ns * work; }
  bool operator==(const StepCost&) const = default;
};

struct CostModel {
  struct Costs {
    StepCost cpu, device;
    bool operator==(const Costs&) const = default;
  };
  std::array<Costs, kNumSteps> steps;

  /// Measured on an Intel Xeon (16 cores) with an NVIDIA H200.
  static CostModel defaults(int threads);

  const Costs& of(Step step) const { return steps[static_cast<std::size_t>(step)]; }
  Costs& of(Step step) { return steps[static_cast<std::size_t>(step)]; }
  /// The device must win clearly: the CPU costs nothing but what is measured, while the device's
  /// time varies more.
  bool device_wins(Step step, double work) const {
    return 1.2 * of(step).device.microseconds(work) < of(step).cpu.microseconds(work);
  }
  bool operator==(const CostModel&) const = default;
};

/// What a calibration is good for.
struct CostModelMachine {
  std::string cpu, device;
  int threads = 1;
  bool operator==(const CostModelMachine&) const = default;
};
/// This one; `device` is empty where there is none.
CostModelMachine this_machine();

/// $XDG_CACHE_HOME/fastloop/cost_model.json, or below ~/.cache; empty without a home.
std::filesystem::path cost_model_file();
/// @throws InputError when the file cannot be written
void save_cost_model(const std::filesystem::path& file, const CostModel& model,
                     const CostModelMachine& machine);
/// The calibration in the file. Defaults without a file, and, with a warning, when it is damaged or
/// belongs to another machine.
/// @param[out] source  where the figures come from, in words; may be null
CostModel load_cost_model(const std::filesystem::path& file, const CostModelMachine& machine,
                          std::string* source = nullptr);
/// That of this machine, read once.
const CostModel& cost_model();

}  // namespace fastloop::loop
