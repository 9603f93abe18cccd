#include "fastloop/compute/cuda_session.hpp"

#include "fastloop/core/logging.hpp"

namespace fastloop {

std::shared_ptr<CudaSession> CudaSession::process_wide() {
  static const std::shared_ptr<CudaSession> session = [] {
    std::string reason;
    std::shared_ptr<CudaSession> opened = open(&reason);
    if (!opened) logger("cuda").info("no CUDA device ({}); the CPU does all the work", reason);
    return opened;
  }();
  return session;
}

void CudaSession::report_failure(const char* step, const std::string& what) {
  const std::lock_guard lock(report_mutex_);
  if (!reported_.insert(step + what).second) return;
  logger("cuda").warn("{} failed on the device ({}); {} on the CPU", step, what,
                      usable() ? "this step is done" : "everything continues");
}

}  // namespace fastloop
