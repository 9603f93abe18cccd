#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/optimization/pose_graph_steps.hpp"

namespace fastloop::optimization::device {

std::unique_ptr<StepExecutor> make_cuda_executor() {
  CudaSession::process_wide();  // says once why there is no device
  return nullptr;
}

}  // namespace fastloop::optimization::device
