#include "bench_command.hpp"

#include "commands.hpp"

namespace fastloop::apps {

void add_bench_command(CLI::App& app, int& exit_code) {
  CLI::App* bench = app.add_subcommand("bench", "Measure loop closing and write tables");
  bench->require_subcommand(1);
  add_bench_loops(*bench, exit_code);
  add_bench_replay(*bench, exit_code);
  add_bench_scale(*bench, exit_code);
}

}  // namespace fastloop::apps
