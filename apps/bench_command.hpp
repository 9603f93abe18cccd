#pragma once

#include <CLI/CLI.hpp>

namespace fastloop::apps {

/// The parts of `fastloop bench`, one file each.
void add_bench_loops(CLI::App& bench, int& exit_code);
void add_bench_replay(CLI::App& bench, int& exit_code);
void add_bench_scale(CLI::App& bench, int& exit_code);

}  // namespace fastloop::apps
