#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "fastloop/eval/loop_table.hpp"
#include "fastloop/loop/backend.hpp"

namespace fastloop::apps {

/// Back ends by name, each once, in the order given. "auto" is the one it stands for here.
/// @throws InvalidArgument on a name this program knows nothing of, or was built without
std::vector<loop::Backend> parse_backends(const std::vector<std::string>& names);

/// Date, machine and command of a result.
eval::BenchInfo bench_info(const std::string& command, const std::vector<loop::Backend>& backends,
                           int runs, int warm_up);

/// The program's command line as it was typed, as far as a shell needs it to say the same again.
std::string command_line();

/// Runs this program again in a process of its own, so that its memory is its own, too.
/// @param log  file that receives what it prints
/// @return exit code; 128 + signal when it was killed
int run_again(const std::vector<std::string>& arguments, const std::filesystem::path& log);

/// Writes the same result as NAME.json, NAME.md and NAME.csv.
void write_results(const std::filesystem::path& folder, const std::string& name,
                   const eval::Json& json, const std::string& markdown, const std::string& csv);

}  // namespace fastloop::apps
