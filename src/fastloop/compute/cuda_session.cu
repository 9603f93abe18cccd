#include <algorithm>
#include <limits>

#include "fastloop/compute/cuda_support.cuh"

namespace fastloop {
namespace {

std::string version_text(int version) {
  return std::to_string(version / 1000) + "." + std::to_string(version % 1000 / 10);
}

/// Errors after which the context is gone for the whole process.
bool is_lost(cudaError_t error) {
  switch (error) {
    case cudaErrorMemoryAllocation:
    case cudaErrorInvalidValue:
    case cudaErrorInvalidConfiguration:
    case cudaErrorLaunchOutOfResources:
      return false;
    default:
      return true;
  }
}

}  // namespace

CudaError::CudaError(cudaError_t error, const char* call)
    : std::runtime_error(std::string(call) + ": " + cudaGetErrorString(error)),
      lost(is_lost(error)) {}

CudaInventory cuda_inventory() {
  CudaInventory inventory;
  inventory.compiled_in = true;
  int version = 0;
  if (cudaRuntimeGetVersion(&version) == cudaSuccess)
    inventory.runtime_version = version_text(version);
  if (cudaDriverGetVersion(&version) == cudaSuccess && version > 0)
    inventory.driver_version = version_text(version);
  int count = 0;
  const cudaError_t error = cudaGetDeviceCount(&count);
  if (error != cudaSuccess || count == 0) {
    inventory.reason = inventory.driver_version.empty() ? "no NVIDIA driver is installed"
                       : error == cudaSuccess           ? "no device was found"
                                                        : cudaGetErrorString(error);
    cudaGetLastError();
    return inventory;
  }
  for (int i = 0; i < count; ++i) {
    cudaDeviceProp p;
    if (cudaGetDeviceProperties(&p, i) != cudaSuccess) continue;
    CudaDeviceInfo device;
    device.index = i;
    device.name = p.name;
    device.compute_major = p.major;
    device.compute_minor = p.minor;
    device.multiprocessors = p.multiProcessorCount;
    device.memory_bytes = p.totalGlobalMem;
    inventory.devices.push_back(device);
  }
  if (inventory.devices.empty()) inventory.reason = "no device answers";
  return inventory;
}

CudaSession::Impl::Impl(int chosen) : device(chosen) {
  use();
  check(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, device),
        "cudaDeviceGetAttribute");
  check(cudaDeviceGetAttribute(&shared_bytes_per_block, cudaDevAttrMaxSharedMemoryPerBlockOptin,
                               device),
        "cudaDeviceGetAttribute");
  check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking), "cudaStreamCreate");
  cudaMemPoolProps properties{};
  properties.allocType = cudaMemAllocationTypePinned;
  properties.location.type = cudaMemLocationTypeDevice;
  properties.location.id = device;
  check(cudaMemPoolCreate(&pool, &properties), "cudaMemPoolCreate");
  std::uint64_t keep = std::numeric_limits<std::uint64_t>::max();
  check(cudaMemPoolSetAttribute(pool, cudaMemPoolAttrReleaseThreshold, &keep),
        "cudaMemPoolSetAttribute");
}

CudaSession::Impl::~Impl() {
  if (stream) {
    cudaStreamSynchronize(stream);
    cudaStreamDestroy(stream);
  }
  if (pool) cudaMemPoolDestroy(pool);
}

void CudaSession::Impl::check(cudaError_t error, const char* call) {
  if (fail_at > 0 && --fail_at == 0)
    error = fail_lost ? cudaErrorIllegalAddress : cudaErrorMemoryAllocation;
  if (error == cudaSuccess) return;
  cudaGetLastError();  // the next check must not see it again
  CudaError failure(error, call);
  if (failure.lost) lost = true;
  throw failure;
}

void CudaSession::Impl::to_device(void* target, const void* source, std::size_t bytes) {
  if (bytes == 0) return;
  check(cudaMemcpyAsync(target, source, bytes, cudaMemcpyHostToDevice, stream), "cudaMemcpyAsync");
  bytes_to_device += bytes;
}

void CudaSession::Impl::to_host(void* target, const void* source, std::size_t bytes) {
  if (bytes == 0) return;
  check(cudaMemcpyAsync(target, source, bytes, cudaMemcpyDeviceToHost, stream), "cudaMemcpyAsync");
  bytes_to_host += bytes;
}

void CudaSession::Impl::clear(void* target, std::size_t bytes) {
  if (bytes > 0) check(cudaMemsetAsync(target, 0, bytes, stream), "cudaMemsetAsync");
}

void CudaSession::Impl::synchronize() {
  ++synchronizations;
  check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

void CudaSession::Impl::launched(const char* kernel) {
  ++launches;
  check(cudaGetLastError(), kernel);
}

void* CudaSession::Impl::allocate_device(std::size_t bytes) {
  void* memory = nullptr;
  check(cudaMallocFromPoolAsync(&memory, std::max<std::size_t>(bytes, 1), pool, stream),
        "cudaMallocFromPoolAsync");
  ++allocations;
  return memory;
}

void CudaSession::Impl::free_device(void* memory) noexcept { cudaFreeAsync(memory, stream); }

void* CudaSession::Impl::allocate_pinned(std::size_t bytes) {
  void* memory = nullptr;
  check(cudaMallocHost(&memory, std::max<std::size_t>(bytes, 1)), "cudaMallocHost");
  ++allocations;
  return memory;
}

void CudaSession::Impl::free_pinned(void* memory) noexcept {
  if (memory) cudaFreeHost(memory);
}

CudaSession::CudaSession() = default;
CudaSession::~CudaSession() = default;

std::shared_ptr<CudaSession> CudaSession::open(std::string* reason) {
  const CudaInventory inventory = cuda_inventory();
  std::string why = inventory.reason;
  if (!inventory.devices.empty()) {
    try {
      std::shared_ptr<CudaSession> session(new CudaSession);
      session->impl_ = std::make_unique<Impl>(inventory.devices.front().index);
      return session;
    } catch (const CudaError& e) {
      why = e.what();
    }
  }
  if (reason) *reason = why;
  return nullptr;
}

bool CudaSession::usable() const { return !impl_->lost; }

CudaCounters CudaSession::counters() const {
  std::uint64_t pool_bytes = 0;
  if (cudaMemPoolGetAttribute(impl_->pool, cudaMemPoolAttrReservedMemHigh, &pool_bytes) !=
      cudaSuccess) {
    cudaGetLastError();
    pool_bytes = 0;
  }
  return {impl_->launches,        impl_->synchronizations, impl_->allocations,
          impl_->bytes_to_device, impl_->bytes_to_host,    impl_->slab_bytes + pool_bytes};
}

void CudaSession::inject_failure(int n, bool lost) {
  impl_->fail_lost = lost;
  impl_->fail_at = n;
}

}  // namespace fastloop
