#include "fastloop/loop/backend.hpp"

#include <string>

#include "fastloop/core/error.hpp"

namespace fastloop::loop {

const char* to_string(Backend backend) {
  switch (backend) {
    case Backend::kAuto:
      return "auto";
    case Backend::kReference:
      return "reference";
    case Backend::kCpu:
      return "cpu";
  }
  return "unknown";
}

Backend parse_backend(std::string_view name) {
  for (const Backend b : {Backend::kAuto, Backend::kReference, Backend::kCpu})
    if (name == to_string(b)) return b;
  throw InvalidArgument("unknown back end \"" + std::string(name) +
                        "\" (expected auto, reference or cpu)");
}

Backend resolve(Backend backend) { return backend == Backend::kAuto ? Backend::kCpu : backend; }

Executor executor_of(Backend backend) {
  return resolve(backend) == Backend::kReference ? Executor::reference() : Executor::cpu();
}

}  // namespace fastloop::loop
