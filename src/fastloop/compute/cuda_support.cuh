#pragma once

#include <cuda_runtime.h>

#include <atomic>
#include <cstddef>
#include <stdexcept>
#include <string>

#include "fastloop/compute/cuda_session.hpp"

/// What CUDA sources of all rooms share: checked calls, one stream, memory that grows and stays.
namespace fastloop {

/// A CUDA call that failed. `lost`: nothing more can be done with the device in this process.
struct CudaError : std::runtime_error {
  CudaError(cudaError_t error, const char* call);
  bool lost;
};

struct CudaSession::Impl {
  explicit Impl(int device);
  ~Impl();

  /// Throws CudaError unless `error` is success. Every call of the runtime goes through here.
  void check(cudaError_t error, const char* call);
  /// To be called at the beginning of every step: makes the device current in this thread.
  void use() { check(cudaSetDevice(device), "cudaSetDevice"); }

  /// Asynchronous on `stream`. Host memory must be pinned (PinnedBuffer) and stay until the copy is
  /// done.
  void to_device(void* target, const void* source, std::size_t bytes);
  void to_host(void* target, const void* source, std::size_t bytes);
  void clear(void* target, std::size_t bytes);
  /// Waits for everything on `stream`.
  void synchronize();
  /// To be called after each kernel launch.
  void launched(const char* kernel);

  void* allocate_device(std::size_t bytes);  ///< stream-ordered, from a pool that keeps what it got
  void free_device(void* memory) noexcept;
  void* allocate_pinned(std::size_t bytes);
  static void free_pinned(void* memory) noexcept;

  int device = 0;
  int multiprocessors = 0;
  int shared_bytes_per_block = 0;  ///< at most, after opting in
  cudaStream_t stream = nullptr;
  cudaMemPool_t pool = nullptr;

  std::atomic<bool> lost{false};
  std::atomic<int> fail_at{0};  ///< counts down; 0: never
  std::atomic<bool> fail_lost{false};
  std::atomic<std::uint64_t> launches{0}, synchronizations{0}, allocations{0}, bytes_to_device{0},
      bytes_to_host{0}, slab_bytes{0};  // slab_bytes: device memory that is not of the pool
};

#define FASTLOOP_CUDA_CHECK(impl, call) (impl).check((call), #call)

/// Elements on the device. Grows by at least half, never shrinks, content lost when it grows.
template <class T>
class DeviceBuffer {
 public:
  DeviceBuffer() = default;
  DeviceBuffer(const DeviceBuffer&) = delete;
  DeviceBuffer& operator=(const DeviceBuffer&) = delete;
  ~DeviceBuffer() { release(); }

  /// The buffer belongs to `session` from the first call on and must not outlive it.
  void reserve(CudaSession::Impl& session, std::size_t count) {
    if (count <= capacity_) return;
    release();
    const std::size_t wanted = count + count / 2;
    data_ = static_cast<T*>(session.allocate_device(wanted * sizeof(T)));
    session_ = &session;
    capacity_ = wanted;
  }
  void release() {
    if (data_) session_->free_device(data_);
    data_ = nullptr;
    capacity_ = 0;
  }
  T* data() const { return data_; }
  std::size_t capacity() const { return capacity_; }

 private:
  T* data_ = nullptr;
  std::size_t capacity_ = 0;
  CudaSession::Impl* session_ = nullptr;
};

/// Page-locked elements on the host, for copies that do not wait. Grows like DeviceBuffer.
template <class T>
class PinnedBuffer {
 public:
  PinnedBuffer() = default;
  PinnedBuffer(const PinnedBuffer&) = delete;
  PinnedBuffer& operator=(const PinnedBuffer&) = delete;
  ~PinnedBuffer() { CudaSession::Impl::free_pinned(data_); }

  /// No copy from or to the buffer may be under way.
  void reserve(CudaSession::Impl& session, std::size_t count) {
    if (count <= capacity_) return;
    CudaSession::Impl::free_pinned(data_);
    data_ = nullptr;
    capacity_ = 0;
    const std::size_t wanted = count + count / 2;
    data_ = static_cast<T*>(session.allocate_pinned(wanted * sizeof(T)));
    capacity_ = wanted;
  }
  T* data() const { return data_; }
  T& operator[](std::size_t i) const { return data_[i]; }
  std::size_t capacity() const { return capacity_; }

 private:
  T* data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace fastloop
