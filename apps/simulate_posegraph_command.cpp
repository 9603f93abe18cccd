#include <cstdio>
#include <memory>
#include <numeric>
#include <string>

#include "commands.hpp"
#include "fastloop/io/g2o.hpp"
#include "fastloop/sim/pose_graph_worlds.hpp"

namespace fastloop::apps {

void add_simulate_posegraph_command(CLI::App& app, int& exit_code) {
  struct Arguments {
    std::string shape, out;
    sim::PoseGraphWorldOptions options;
  };
  auto a = std::make_shared<Arguments>();
  CLI::App* command = app.add_subcommand(
      "simulate-posegraph", "Make a pose graph like that of a SLAM system closing a loop, as a g2o file");
  command->add_option("shape", a->shape, "loop, laps, city or campus")
      ->required()
      ->check(CLI::IsMember({"loop", "laps", "city", "campus"}));
  command->add_option("--poses", a->options.poses, "Number of keyframes")
      ->check(CLI::Range(30, 1000000))
      ->capture_default_str();
  command->add_option("--dof", a->options.dof, "4 (yaw and translation), 6 (SE3) or 7 (Sim3)")
      ->check(CLI::IsMember({4, 6, 7}))
      ->capture_default_str();
  command->add_option("--seed", a->options.seed)->capture_default_str();
  command->add_option("--out", a->out, "g2o file to write (default: SHAPE.g2o)");
  command->callback([a, &exit_code] {
    a->options.shape = sim::pose_graph_shape(a->shape);
    io::G2oGraph graph;
    graph.problem = sim::make_pose_graph_world(a->options).problem;
    graph.ids.resize(graph.problem.poses.size());
    std::iota(graph.ids.begin(), graph.ids.end(), 0);
    const std::string file = a->out.empty() ? a->shape + ".g2o" : a->out;
    io::write_g2o(file, graph);
    std::printf("%s: %zu vertices, %zu edges; solve with: fastloop posegraph %s --dof %d\n", file.c_str(),
                graph.problem.poses.size(), graph.problem.edges.size(), file.c_str(), a->options.dof);
    exit_code = kExitOk;
  });
}

}  // namespace fastloop::apps
