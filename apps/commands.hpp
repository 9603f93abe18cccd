#pragma once

#include <CLI/CLI.hpp>

namespace fastloop::apps {

/// Exit codes of the program.
inline constexpr int kExitOk = 0, kExitBadInput = 2, kExitNeverInitialised = 3, kExitThresholdMissed = 4;

/// Each command registers its options on `app` and stores its exit code in `exit_code` when it runs.
void add_eval_command(CLI::App& app, int& exit_code);
void add_bench_command(CLI::App& app, int& exit_code);
void add_convert_calib_command(CLI::App& app, int& exit_code);
void add_simulate_command(CLI::App& app, int& exit_code);
void add_run_command(CLI::App& app, int& exit_code);
void add_doctor_command(CLI::App& app, int& exit_code);
void add_posegraph_command(CLI::App& app, int& exit_code);
void add_map_command(CLI::App& app, int& exit_code);
void add_replay_command(CLI::App& app, int& exit_code);
void add_report_command(CLI::App& app, int& exit_code);
void add_simulate_map_command(CLI::App& app, int& exit_code);
void add_simulate_posegraph_command(CLI::App& app, int& exit_code);
void add_vocab_command(CLI::App& app, int& exit_code);

}  // namespace fastloop::apps
