#include "fastloop/loop/backend.hpp"

#include <string>

#include "fastloop/compute/cuda_session.hpp"
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
    case Backend::kCuda:
      return "cuda";
  }
  return "unknown";
}

Backend parse_backend(std::string_view name) {
  for (const Backend b : {Backend::kAuto, Backend::kReference, Backend::kCpu, Backend::kCuda})
    if (name == to_string(b)) return b;
  throw InvalidArgument("unknown back end \"" + std::string(name) +
                        "\" (expected auto, reference, cpu or cuda)");
}

Backend resolve(Backend backend) {
  if (backend == Backend::kReference || backend == Backend::kCpu) return backend;
  // A build without CUDA is no news to one who did not ask for it.
  if (backend == Backend::kAuto && !cuda_inventory().compiled_in) return Backend::kCpu;
  return CudaSession::process_wide() ? backend : Backend::kCpu;
}

StepExecutors executors_of(Backend backend) {
  switch (resolve(backend)) {
    case Backend::kReference:
      return Executor::reference();
    case Backend::kCuda:
      return Executor::cuda(CudaSession::process_wide());
    case Backend::kAuto:
      return {Executor::cpu(), Executor::cuda(CudaSession::process_wide()), cost_model()};
    default:
      return Executor::cpu();
  }
}

}  // namespace fastloop::loop
