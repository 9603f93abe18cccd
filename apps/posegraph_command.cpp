#include <cstdio>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>

#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/io/g2o.hpp"
#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::apps {
namespace {

using namespace fastloop::optimization;

struct PoseGraphArguments {
  std::string file, out, solver = "block", information = "sesync", kernel = "none";
  std::optional<int> dof;
  bool json = false, fixed_scale = false;
  double rejection_gate = 0;
  PoseGraphOptions options;
};

PoseGraphSolverKind solver_named(const std::string& name) {
  if (name == "ceres") return PoseGraphSolverKind::kCeres;
  if (name == "cuda") return PoseGraphSolverKind::kCuda;
  return name == "reference" ? PoseGraphSolverKind::kReference : PoseGraphSolverKind::kBlock;
}

RobustKernel kernel_named(const std::string& name) {
  if (name == "huber") return RobustKernel::kHuber;
  if (name == "cauchy") return RobustKernel::kCauchy;
  return name == "dcs" ? RobustKernel::kDynamicCovarianceScaling : RobustKernel::kNone;
}

nlohmann::ordered_json to_json(const PoseGraphArguments& a, const io::G2oGraph& graph, const PoseGraphResult& r) {
  const PoseGraphKind kind = graph.problem.kind;
  return {{"file", a.file},
          {"solver", a.solver},
          {"dof", kind == PoseGraphKind::kYaw ? 4 : kind == PoseGraphKind::kSe3 || a.fixed_scale ? 6 : 7},
          {"vertices", graph.problem.poses.size()},
          {"edges", graph.problem.edges.size()},
          {"components", r.components},
          {"anchored", r.anchored},
          {"status", to_string(r.status)},
          {"reason", r.reason},
          {"initial_cost", r.initial_cost},
          {"final_cost", r.final_cost},
          {"iterations", r.iterations},
          {"factorizations", r.factorizations},
          {"cost_history", r.cost_history},
          {"rejected_edges", r.rejected},
          {"total_ms", r.times.total_ms},
          {"split_ms",
           {{"ordering", r.times.ordering_ms},
            {"symbolic", r.times.symbolic_ms},
            {"linearize", r.times.linearize_ms},
            {"factor", r.times.factor_ms},
            {"solve", r.times.solve_ms},
            {"update", r.times.update_ms}}}};
}

void print_text(const PoseGraphArguments& a, const io::G2oGraph& graph, const PoseGraphResult& r) {
  std::printf("%s: %zu vertices, %zu edges, %d components, solver %s\n", a.file.c_str(),
              graph.problem.poses.size(), graph.problem.edges.size(), r.components, a.solver.c_str());
  std::printf("%-12s %14s %14s\n", "step", "cost", "decrease");
  for (std::size_t k = 0; k < r.cost_history.size(); ++k)
    std::printf("%-12zu %14.8g %14.4g\n", k, r.cost_history[k],
                k == 0 ? 0.0 : r.cost_history[k - 1] - r.cost_history[k]);
  std::printf("%s%s%s, %d iterations, %d factorisations\n", std::string(to_string(r.status)).c_str(),
              r.reason.empty() ? "" : ": ", r.reason.c_str(), r.iterations, r.factorizations);
  if (!r.rejected.empty()) std::printf("rejected %zu loop edges\n", r.rejected.size());
  std::printf("ms: total %.3f, ordering %.3f, symbolic %.3f, linearise %.3f, factor %.3f, solve %.3f, update %.3f\n",
              r.times.total_ms, r.times.ordering_ms, r.times.symbolic_ms, r.times.linearize_ms,
              r.times.factor_ms, r.times.solve_ms, r.times.update_ms);
}

int run(PoseGraphArguments& a) {
  const io::G2oInformation information = a.information == "g2o"     ? io::G2oInformation::kQuaternion
                                         : a.information == "angle" ? io::G2oInformation::kRotationVector
                                                                    : io::G2oInformation::kIsotropic;
  io::G2oGraph graph = io::read_g2o(a.file, a.dof, information);
  graph.problem.fixed_scale = a.fixed_scale;
  a.options.solver = solver_named(a.solver);
  a.options.robust_kernel = kernel_named(a.kernel);
  a.options.split_times = true;
  if (a.rejection_gate > 0) a.options.rejection_gate = a.rejection_gate;
  const PoseGraphResult result = solve_pose_graph(graph.problem, a.options);
  if (!result.usable()) throw InputError({a.file, 0, ""}, result.reason);
  if (a.json) {
    std::printf("%s\n", to_json(a, graph, result).dump(2).c_str());
  } else {
    print_text(a, graph, result);
  }
  if (!a.out.empty()) io::write_g2o(a.out, graph, information);
  return kExitOk;
}

}  // namespace

void add_posegraph_command(CLI::App& app, int& exit_code) {
  auto a = std::make_shared<PoseGraphArguments>();
  CLI::App* command = app.add_subcommand("posegraph", "Optimise a pose graph in a g2o file");
  command->add_option("file", a->file, "g2o file with SE2, SE3:QUAT or SIM3 lines")->required();
  command->add_option("--solver", a->solver,
                      "block (ours), cuda (ours on the GPU), ceres, or reference (the published way)")
      ->check(CLI::IsMember({"block", "cuda", "ceres", "reference"}))
      ->capture_default_str();
  command->add_option("--dof", a->dof, "4 (yaw and translation), 6 (SE3) or 7 (Sim3); default: as the file")
      ->check(CLI::IsMember({4, 6, 7}));
  command->add_flag("--fixed-scale", a->fixed_scale, "With --dof 7: keep the scale of every vertex");
  command->add_option("--information", a->information,
                      "What the information of SE3:QUAT edges weights: sesync (isotropic means of it the rotation "
                      "vector, as SE-Sync), angle (the rotation vector, as GTSAM) or g2o (half of it, as g2o)")
      ->check(CLI::IsMember({"g2o", "angle", "sesync"}))
      ->capture_default_str();
  command->add_option("--threads", a->options.threads, "Threads; the result does not depend on it")
      ->capture_default_str();
  command->add_option("--max-iterations", a->options.max_iterations)->capture_default_str();
  command->add_option("--tolerance", a->options.relative_tolerance, "Relative decrease at which to stop")
      ->capture_default_str();
  command->add_option("--kernel", a->kernel, "Robust kernel on edges between vertices that do not follow each other")
      ->check(CLI::IsMember({"none", "huber", "cauchy", "dcs"}))
      ->capture_default_str();
  command->add_option("--kernel-width", a->options.robust_width, "In standard deviations")->capture_default_str();
  command->add_option("--reject", a->rejection_gate,
                      "Take out such edges with a squared residual above this, and solve again");
  command->add_option("--out", a->out, "Write the optimised graph to this file");
  command->add_flag("--json", a->json, "Report as JSON");
  command->callback([a, &exit_code] { exit_code = run(*a); });
}

}  // namespace fastloop::apps
