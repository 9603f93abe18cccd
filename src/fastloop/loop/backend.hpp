#pragma once

#include <string_view>

#include "fastloop/loop/step_executors.hpp"

namespace fastloop::loop {

/// How loops are closed.
enum class Backend {
  kAuto,       ///< for each step the fastest that this machine has
  kReference,  ///< the published sequential algorithm, scalar, one thread: oracle and baseline
  kCpu,        ///< the parallel algorithm on all cores
  kCuda,       ///< the parallel algorithm on a device, as far as its steps have a device version
};

const char* to_string(Backend backend);
/// @throws InvalidArgument on an unknown name
Backend parse_backend(std::string_view name);
/// What a back end stands for here: without a device, kAuto and kCuda are kCpu. The first call
/// logs that a device is missing.
Backend resolve(Backend backend);
StepExecutors executors_of(Backend backend);

}  // namespace fastloop::loop
