#include "fastloop/compute/cuda_session.hpp"

namespace fastloop {

/// Never made in this build: open() returns null.
struct CudaSession::Impl {};

CudaSession::CudaSession() = default;
CudaSession::~CudaSession() = default;

CudaInventory cuda_inventory() {
  CudaInventory inventory;
  inventory.reason = "this build has no CUDA back end";
  return inventory;
}

std::shared_ptr<CudaSession> CudaSession::open(std::string* reason) {
  if (reason) *reason = cuda_inventory().reason;
  return nullptr;
}

bool CudaSession::usable() const { return false; }
CudaCounters CudaSession::counters() const { return {}; }
void CudaSession::inject_failure(int, bool) {}

}  // namespace fastloop
