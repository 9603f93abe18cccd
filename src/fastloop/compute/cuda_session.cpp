#include "fastloop/compute/cuda_session.hpp"

#include <atomic>

#include "fastloop/core/logging.hpp"

namespace fastloop {
namespace {

std::atomic<const CudaSession*> opened_for_all{nullptr};

}  // namespace

std::shared_ptr<CudaSession> CudaSession::process_wide() {
  static const std::shared_ptr<CudaSession> session = [] {
    std::string reason;
    std::shared_ptr<CudaSession> opened = open(&reason);
    if (!opened) logger("cuda").info("no CUDA device ({}); the CPU does all the work", reason);
    opened_for_all = opened.get();
    return opened;
  }();
  return session;
}

std::optional<CudaCounters> CudaSession::process_wide_counters() {
  const CudaSession* session = opened_for_all;
  return session ? std::optional(session->counters()) : std::nullopt;
}

void CudaSession::report_failure(const char* step, const std::string& what) {
  const std::lock_guard lock(report_mutex_);
  if (!reported_.insert(step + what).second) return;
  logger("cuda").warn("{} failed on the device ({}); {} on the CPU", step, what,
                      usable() ? "this step is done" : "everything continues");
}

}  // namespace fastloop
