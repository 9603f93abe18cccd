#pragma once

#include <vector>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/compute/executor.hpp"

/// The executors whose results must agree with the reference's.
namespace fastloop::testing {

/// cpu, and cuda where there is a device.
inline std::vector<Executor> parallel_executors() {
  std::vector<Executor> executors{Executor::cpu()};
  if (auto session = CudaSession::process_wide()) executors.push_back(Executor::cuda(session));
  return executors;
}

/// reference first.
inline std::vector<Executor> all_executors() {
  std::vector<Executor> executors = parallel_executors();
  executors.insert(executors.begin(), Executor::reference());
  return executors;
}

}  // namespace fastloop::testing
