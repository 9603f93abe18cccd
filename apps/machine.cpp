#include "machine.hpp"

#include <ctime>
#include <fstream>
#include <sstream>
#include <thread>

#include "fastloop_commit.hpp"

namespace fastloop::apps {

std::string proc_value(const char* file, const std::string& key) {
  std::ifstream in(file);
  for (std::string line; std::getline(in, line);) {
    const auto colon = line.find(':');
    if (!line.starts_with(key) || colon == std::string::npos) continue;
    const auto begin = line.find_first_not_of(" \t", colon + 1);
    return begin == std::string::npos ? "" : line.substr(begin);
  }
  return "";
}

io::MachineFacts machine_facts() {
  io::MachineFacts m;
  m.cpu = proc_value("/proc/cpuinfo", "model name");
  m.cores = std::thread::hardware_concurrency();
  std::istringstream total(proc_value("/proc/meminfo", "MemTotal"));
  double kibibytes = 0;
  if (total >> kibibytes) m.memory_gib = kibibytes / (1024.0 * 1024.0);
  m.compiler = FASTLOOP_COMPILER;
  m.build = FASTLOOP_BUILD_TYPE;
  m.commit = FASTLOOP_COMMIT;
  return m;
}

std::string utc_now() {
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  gmtime_r(&now, &utc);
  char text[40];
  std::strftime(text, sizeof text, "%Y-%m-%d %H:%M UTC", &utc);
  return text;
}

}  // namespace fastloop::apps
