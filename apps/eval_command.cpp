#include <cstdio>
#include <filesystem>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>

#include "commands.hpp"
#include "fastloop/eval/evaluation.hpp"
#include "fastloop/eval/plot.hpp"
#include "fastloop/io/trajectory.hpp"

namespace fastloop::apps {
namespace {

struct EvalArguments {
  std::string ground_truth, estimate, align = "se3";
  std::string times, plot;
  std::optional<double> rpe_seconds, max_ate_m, min_coverage;
  bool json = false;
};

nlohmann::ordered_json to_json(const eval::Statistics& s) {
  return {{"count", s.count}, {"rmse", s.rmse}, {"mean", s.mean}, {"median", s.median},
          {"std", s.std},     {"min", s.min},   {"max", s.max}};
}

nlohmann::ordered_json to_json(const EvalArguments& arguments, const eval::Evaluation& e) {
  nlohmann::ordered_json j{
      {"ground_truth", arguments.ground_truth},
      {"estimate", arguments.estimate},
      {"align", arguments.align},
      {"scale", e.alignment.scale},
      {"matched", e.errors_m.size()},
      {"ground_truth_poses", e.reference_poses},
      {"estimate_poses", e.estimate_poses},
      {"coverage_percent", 100 * e.coverage},
      {"path_length_m", e.path_length_m},
      {"ate_m", to_json(e.ate_m)},
      {"ate_percent_of_path", e.ate_percent},
      {"end_drift_percent_of_path", e.end_drift_percent},
  };
  if (e.rpe) {
    j["rpe"] = {{"seconds", e.rpe->seconds},
                {"translation_m", to_json(e.rpe->translation_m)},
                {"rotation_deg", to_json(e.rpe->rotation_deg)},
                {"consecutive_translation_m", to_json(e.rpe->consecutive_translation_m)},
                {"consecutive_rotation_deg", to_json(e.rpe->consecutive_rotation_deg)}};
  }
  return j;
}

void print_statistics(const char* name, const eval::Statistics& s) {
  std::printf("%-22s %11.6f %11.6f %11.6f %11.6f %11.6f %11.6f\n", name, s.rmse, s.mean, s.median,
              s.std, s.min, s.max);
}

void print_text(const EvalArguments& arguments, const eval::Evaluation& e) {
  std::printf("ground truth  %s (%zu poses)\n", arguments.ground_truth.c_str(), e.reference_poses);
  std::printf("estimate      %s (%zu poses)\n", arguments.estimate.c_str(), e.estimate_poses);
  std::printf("matched       %zu poses, coverage %.1f %% of the ground truth\n", e.errors_m.size(),
              100 * e.coverage);
  std::printf("path          %.3f m\n", e.path_length_m);
  std::printf("alignment     %s, scale %.6f\n\n", arguments.align.c_str(), e.alignment.scale);
  std::printf("%-22s %11s %11s %11s %11s %11s %11s\n", "", "rmse", "mean", "median", "std", "min",
              "max");
  print_statistics("ATE [m]", e.ate_m);
  if (e.rpe) {
    std::printf("RPE over %g s, %zu pairs (consecutive: %zu)\n", e.rpe->seconds,
                e.rpe->translation_m.count, e.rpe->consecutive_translation_m.count);
    print_statistics("  translation [m]", e.rpe->translation_m);
    print_statistics("  rotation [deg]", e.rpe->rotation_deg);
    print_statistics("  consecutive [m]", e.rpe->consecutive_translation_m);
    print_statistics("  consecutive [deg]", e.rpe->consecutive_rotation_deg);
  }
  std::printf("\nATE is %.3f %% of the path; drift from the first to the last pose %.3f %%\n",
              e.ate_percent, e.end_drift_percent);
}

io::Trajectory read(const std::string& file, const EvalArguments& arguments) {
  io::TrajectoryOptions options;
  if (!arguments.times.empty()) options.kitti_times = arguments.times;
  auto trajectory = io::read_trajectory(file, options);
  for (const std::string& remark : trajectory.remarks)
    std::cerr << "fastloop: " << file << ": " << remark << "\n";
  return trajectory;
}

/// True when every threshold that was asked for is met; says on stderr which is not.
bool thresholds_met(const EvalArguments& arguments, const eval::Evaluation& e) {
  bool met = true;
  if (arguments.max_ate_m && !(e.ate_m.rmse <= *arguments.max_ate_m)) {
    std::fprintf(stderr, "fastloop: ATE RMSE %.6f m is above --max-ate %g m\n", e.ate_m.rmse,
                 *arguments.max_ate_m);
    met = false;
  }
  if (arguments.min_coverage && !(100 * e.coverage >= *arguments.min_coverage)) {
    std::fprintf(stderr, "fastloop: coverage %.2f %% is below --min-coverage %g %%\n",
                 100 * e.coverage, *arguments.min_coverage);
    met = false;
  }
  return met;
}

int run_eval(const EvalArguments& arguments) {
  eval::EvaluationOptions options;
  options.alignment = arguments.align == "none"   ? eval::AlignmentKind::kNone
                      : arguments.align == "sim3" ? eval::AlignmentKind::kSim3
                                                  : eval::AlignmentKind::kSe3;
  options.rpe_seconds = arguments.rpe_seconds;
  const auto ground_truth = read(arguments.ground_truth, arguments);
  const auto estimate = read(arguments.estimate, arguments);
  const auto evaluation = eval::evaluate(ground_truth.poses, estimate.poses, options);
  if (arguments.json) {
    std::cout << to_json(arguments, evaluation).dump(2) << "\n";
  } else {
    print_text(arguments, evaluation);
  }
  if (!arguments.plot.empty()) {
    const std::string name = std::filesystem::path(arguments.estimate).filename().string();
    eval::write_svg(arguments.plot, evaluation,
                    name + " against ground truth (alignment: " + arguments.align + ")");
  }
  return thresholds_met(arguments, evaluation) ? kExitOk : kExitThresholdMissed;
}

}  // namespace

void add_eval_command(CLI::App& app, int& exit_code) {
  auto arguments = std::make_shared<EvalArguments>();
  CLI::App* command = app.add_subcommand(
      "eval",
      "Compare a trajectory with the ground truth: ATE and RPE, as the tool evo defines them");
  command
      ->add_option(
          "GROUNDTRUTH", arguments->ground_truth,
          "Trajectory file: TUM (seconds x y z qx qy qz qw), EuRoC csv "
          "(nanoseconds,x,y,z,qw,qx,qy,qz,...) or KITTI (12 numbers a line); recognised by itself")
      ->required();
  command->add_option("ESTIMATE", arguments->estimate, "Trajectory file, in any of these formats")
      ->required();
  command
      ->add_option("--align", arguments->align,
                   "Move the estimate onto the ground truth first: se3 (rotation and translation), "
                   "sim3 (scale too) or none")
      ->check(CLI::IsMember({"se3", "sim3", "none"}))
      ->capture_default_str();
  command
      ->add_option("--rpe", arguments->rpe_seconds,
                   "Also the relative error over this many seconds")
      ->check(CLI::PositiveNumber);
  command->add_option("--times", arguments->times,
                      "Stamps (seconds, one a line) of trajectories in KITTI format");
  command->add_flag("--json", arguments->json, "Print JSON with all digits");
  command->add_option("--plot", arguments->plot, "Write a picture of paths and errors (SVG)");
  command->add_option("--max-ate", arguments->max_ate_m,
                      "Exit with code 4 when the ATE RMSE is above this many metres");
  command->add_option(
      "--min-coverage", arguments->min_coverage,
      "Exit with code 4 when less than this percentage of the ground truth is covered");
  command->footer(
      "Poses are matched by time within 0.01 s.\n"
      "Example: fastloop eval room/mav0/state_groundtruth_estimate0/data.csv "
      "result/trajectory_body.txt --rpe 1 --plot error.svg");
  command->callback([arguments, &exit_code] { exit_code = run_eval(*arguments); });
}

}  // namespace fastloop::apps
