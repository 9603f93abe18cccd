#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

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

  const T& operator[](std::size_t i) const {
    return chunks_[i / kChunkSize]->items[i % kChunkSize];
  }

  /// Writable element; clones its chunk when shared. Threads may write to different chunks.
  T& mutate(std::size_t i) {
    ChunkPointer& chunk = chunks_[i / kChunkSize];
    if (!chunk.unique()) chunk = ChunkPointer(new Chunk(*chunk));
    return chunk->items[i % kChunkSize];
  }

  void push_back(T value) {
    if (size_ % kChunkSize == 0) chunks_.push_back(ChunkPointer(new Chunk()));
    ++size_;
    mutate(size_ - 1) = std::move(value);
  }

 private:
  struct Chunk {
    std::array<T, kChunkSize> items{};
    std::atomic<std::uint32_t> references{0};
    Chunk() = default;
    Chunk(const Chunk& o) : items(o.items) {}
  };

  /// Intrusive counted pointer. `unique` synchronises with the release of the last other reference,
  /// which std::shared_ptr::use_count does not promise.
  class ChunkPointer {
   public:
    explicit ChunkPointer(Chunk* chunk) : chunk_(chunk) { retain(); }
    ChunkPointer(const ChunkPointer& o) : chunk_(o.chunk_) { retain(); }
    ChunkPointer(ChunkPointer&& o) noexcept : chunk_(std::exchange(o.chunk_, nullptr)) {}
    ChunkPointer& operator=(ChunkPointer o) noexcept {
      std::swap(chunk_, o.chunk_);
      return *this;
    }
    ~ChunkPointer() {
      if (chunk_ && chunk_->references.fetch_sub(1, std::memory_order_acq_rel) == 1) delete chunk_;
    }
    bool unique() const { return chunk_->references.load(std::memory_order_acquire) == 1; }
    Chunk* operator->() const { return chunk_; }
    Chunk& operator*() const { return *chunk_; }

   private:
    void retain() { chunk_->references.fetch_add(1, std::memory_order_relaxed); }
    Chunk* chunk_;
  };

  std::vector<ChunkPointer> chunks_;
  std::size_t size_ = 0;
};

}  // namespace fastloop
