#pragma once

#include <string_view>

#include "fastloop/compute/executor.hpp"

namespace fastloop::loop {

/// How loops are closed.
enum class Backend {
  kAuto,       ///< the fastest that this machine has
  kReference,  ///< the published sequential algorithm, scalar, one thread: oracle and baseline
  kCpu,        ///< the parallel algorithm on all cores
};

const char* to_string(Backend backend);
/// @throws InvalidArgument on an unknown name
Backend parse_backend(std::string_view name);
/// What kAuto stands for here.
Backend resolve(Backend backend);
Executor executor_of(Backend backend);

}  // namespace fastloop::loop
