#pragma once

#include <spdlog/spdlog.h>

#include <string>

namespace fastloop {

/// The logger of a module ("tracking", "mapping", ...), created at first use; writes to stderr.
/// Thread-safe. Libraries never print to stdout.
spdlog::logger& logger(const std::string& module);

/// Level of all present and future module loggers.
void set_log_level(spdlog::level::level_enum level);

}  // namespace fastloop
