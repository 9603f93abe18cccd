#include <exception>
#include <iostream>

#include "commands.hpp"
#include "fastloop/core/error.hpp"

int main(int argc, char** argv) {
  using namespace fastloop;
  CLI::App app{
      "fastloop: stereo, stereo-inertial and RGB-D SLAM.\n"
      "Start with: fastloop simulate room --out /tmp/room && fastloop run /tmp/room --out /tmp/result"};
  app.require_subcommand(1);
  app.set_version_flag("--version", FASTLOOP_VERSION);
  app.set_help_all_flag("--help-all", "Help of every command");
  int exit_code = apps::kExitOk;
  apps::add_eval_command(app, exit_code);
  apps::add_bench_command(app, exit_code);
  apps::add_convert_calib_command(app, exit_code);
  apps::add_doctor_command(app, exit_code);
  apps::add_map_command(app, exit_code);
  apps::add_posegraph_command(app, exit_code);
  apps::add_replay_command(app, exit_code);
  apps::add_report_command(app, exit_code);
  apps::add_run_command(app, exit_code);
  apps::add_simulate_command(app, exit_code);
  apps::add_simulate_map_command(app, exit_code);
  apps::add_simulate_posegraph_command(app, exit_code);
  apps::add_vocab_command(app, exit_code);

  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? apps::kExitOk : apps::kExitBadInput;
  } catch (const Error& e) {
    std::cerr << "fastloop: " << e.what() << "\n";
    return apps::kExitBadInput;
  } catch (const std::exception& e) {
    std::cerr << "fastloop: " << e.what() << "\n";
    return 1;
  }
  return exit_code;
}
