#include "fastloop/core/logging.hpp"

#include <spdlog/sinks/stdout_color_sinks.h>

#include <mutex>

namespace fastloop {
namespace {
std::mutex creation_mutex;
}

spdlog::logger& logger(const std::string& module) {
  const std::string name = "fastloop." + module;
  if (auto existing = spdlog::get(name)) return *existing;
  const std::lock_guard lock(creation_mutex);
  if (auto existing = spdlog::get(name)) return *existing;
  auto created = spdlog::stderr_color_mt(name);
  created->set_pattern("%^[%l]%$ %n: %v");
  return *created;
}

void set_log_level(spdlog::level::level_enum level) {
  spdlog::set_level(level);
}

}  // namespace fastloop
