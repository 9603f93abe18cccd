#include "bench_support.hpp"

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>

#include <algorithm>
#include <cerrno>
#include <fstream>
#include <iterator>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/io/text.hpp"
#include "machine.hpp"

extern char** environ;

namespace fastloop::apps {

std::vector<loop::Backend> parse_backends(const std::vector<std::string>& names) {
  std::vector<loop::Backend> backends;
  for (const std::string& name : names) {
    const loop::Backend asked = loop::parse_backend(name);
    const loop::Backend backend = loop::resolve(asked);
    if (asked == loop::Backend::kCuda && backend != asked)  // its figures would be those of the CPU
      throw InvalidArgument(cuda_inventory().compiled_in
                                ? "the back end cuda needs a device: " + cuda_inventory().reason
                                : "the back end cuda is not built into this program");
    if (std::find(backends.begin(), backends.end(), backend) == backends.end())
      backends.push_back(backend);
  }
  return backends;
}

std::string command_line() {
  std::ifstream in("/proc/self/cmdline", std::ios::binary);
  const std::string all{std::istreambuf_iterator<char>(in), {}};
  std::string line;
  for (std::size_t at = 0; at < all.size();) {
    const std::size_t end = std::min(all.find('\0', at), all.size());
    std::string word = all.substr(at, end - at);
    at = end + 1;
    if (line.empty()) word = std::filesystem::path(word).filename().string();
    if (word.find_first_of(" '\"$&;()*") != std::string::npos) word = "'" + word + "'";
    line += (line.empty() ? "" : " ") + word;
  }
  return line;
}

eval::BenchInfo bench_info(const std::string& command, const std::vector<loop::Backend>& backends,
                           int runs, int warm_up) {
  eval::BenchInfo info;
  info.command = command;
  info.date = utc_now();
  info.machine = machine_facts();
  info.runs = runs;
  info.warm_up = warm_up;
  for (const loop::Backend b : backends) info.backends.push_back(loop::to_string(b));
  return info;
}

int run_again(const std::vector<std::string>& arguments, const std::filesystem::path& log) {
  const std::string program = std::filesystem::read_symlink("/proc/self/exe").string();
  std::vector<std::string> words{program};
  words.insert(words.end(), arguments.begin(), arguments.end());
  std::vector<char*> argv;
  for (std::string& word : words) argv.push_back(word.data());
  argv.push_back(nullptr);
  posix_spawn_file_actions_t actions;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_addopen(&actions, 0, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_addopen(&actions, 1, log.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644);
  posix_spawn_file_actions_adddup2(&actions, 1, 2);
  pid_t pid = 0;
  const int failed = posix_spawn(&pid, program.c_str(), &actions, nullptr, argv.data(), environ);
  posix_spawn_file_actions_destroy(&actions);
  if (failed) throw Error("cannot start " + program);
  int status = 0;
  while (waitpid(pid, &status, 0) < 0)
    if (errno != EINTR) throw Error("cannot wait for " + program);
  return WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
}

void write_results(const std::filesystem::path& folder, const std::string& name,
                   const eval::Json& json, const std::string& markdown, const std::string& csv) {
  io::write_text_file(folder / (name + ".json"), json.dump(2) + "\n");
  io::write_text_file(folder / (name + ".md"), markdown);
  io::write_text_file(folder / (name + ".csv"), csv);
}

}  // namespace fastloop::apps
