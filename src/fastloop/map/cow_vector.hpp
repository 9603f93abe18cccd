#pragma once

#include <array>
#include <cstddef>
#include <utility>
#include <vector>

#include "fastloop/map/cow_pointer.hpp"

namespace fastloop {

/// Growing sequence whose copies share their contents in chunks; a chunk is cloned when an owner
/// writes to it while another copy still refers to it (copy on write).
///
/// Copying costs one pointer per chunk, so a whole map is snapshot in microseconds. One thread may
/// write to its own copy while other threads read theirs; a single object is not synchronised.
template <class T, std::size_t kChunkSize>
class CowVector {
 public:
  static constexpr std::size_t kItems = kChunkSize;  ///< of a chunk

  std::size_t size() const { return size_; }
  bool empty() const { return size_ == 0; }

  const T& operator[](std::size_t i) const { return (*chunks_[i / kChunkSize])[i % kChunkSize]; }

  /// Writable element; clones its chunk when shared. Threads may write to different chunks.
  T& mutate(std::size_t i) { return chunks_[i / kChunkSize].mutate()[i % kChunkSize]; }

  void push_back(T value) {
    if (size_ % kChunkSize == 0) chunks_.emplace_back();
    ++size_;
    mutate(size_ - 1) = std::move(value);
  }

 private:
  std::vector<CowPointer<std::array<T, kChunkSize>>> chunks_;
  std::size_t size_ = 0;
};

}  // namespace fastloop
