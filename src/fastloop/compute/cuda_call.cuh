#pragma once

#include <nvtx3/nvToolsExt.h>

#include "fastloop/compute/cuda_support.cuh"

/// For steps that send everything they need in one copy and get everything back in another.
namespace fastloop {

/// Memory of one such step at a time, a part of the session: to be used under its mutex. Grows to
/// the largest step, after which nothing is allocated.
struct CudaCallMemory {
  explicit CudaCallMemory(CudaSession&) {}
  PinnedBuffer<std::byte> staging, results;  ///< on the host
  DeviceBuffer<std::byte> input, output;
};

/// Places of the parts of a block of memory, each aligned to 256.
class BlockLayout {
 public:
  template <class T>
  std::size_t add(std::size_t count) {
    const std::size_t at = bytes_;
    bytes_ = (bytes_ + count * sizeof(T) + 255) / 256 * 256;
    return at;
  }
  std::size_t bytes() const { return bytes_; }

 private:
  std::size_t bytes_ = 0;
};

/// Waits for the stream when a step is left by an exception, before what it uses is let go.
class CudaWaitOnFailure {
 public:
  explicit CudaWaitOnFailure(CudaSession::Impl& session) : stream_(session.stream) {}
  ~CudaWaitOnFailure() {
    if (armed_) cudaStreamSynchronize(stream_);
  }
  CudaWaitOnFailure(const CudaWaitOnFailure&) = delete;
  CudaWaitOnFailure& operator=(const CudaWaitOnFailure&) = delete;
  /// The step is through and the host has waited.
  void disarm() { armed_ = false; }

 private:
  cudaStream_t stream_;
  bool armed_ = true;
};

/// Names what happens on the host in the time line of a profiler.
class CudaRange {
 public:
  explicit CudaRange(const char* name) { nvtxRangePushA(name); }
  ~CudaRange() { nvtxRangePop(); }
  CudaRange(const CudaRange&) = delete;
  CudaRange& operator=(const CudaRange&) = delete;
};

}  // namespace fastloop
