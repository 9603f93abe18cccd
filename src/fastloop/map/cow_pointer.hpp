#pragma once

#include <atomic>
#include <cstdint>
#include <utility>

namespace fastloop {

/// Counted pointer whose copies share one value until an owner writes to it: copy on write. One
/// thread may write through its own copy while others read through theirs; a single object is not
/// synchronised.
template <class T>
class CowPointer {
 public:
  CowPointer() : node_(new Node) {}
  explicit CowPointer(T value) : node_(new Node{std::move(value)}) {}
  CowPointer(const CowPointer& o) : node_(o.node_) {
    node_->references.fetch_add(1, std::memory_order_relaxed);
  }
  CowPointer(CowPointer&& o) noexcept : node_(std::exchange(o.node_, nullptr)) {}
  CowPointer& operator=(CowPointer o) noexcept {
    std::swap(node_, o.node_);
    return *this;
  }
  ~CowPointer() {
    if (node_ && node_->references.fetch_sub(1, std::memory_order_acq_rel) == 1) delete node_;
  }

  const T& operator*() const { return node_->value; }
  const T* operator->() const { return &node_->value; }

  /// The value to write to; cloned first while others refer to it. Sees everything that was done
  /// before the last other reference was released, which std::shared_ptr::use_count does not promise.
  T& mutate() {
    if (node_->references.load(std::memory_order_acquire) != 1) *this = CowPointer(node_->value);
    return node_->value;
  }

 private:
  struct Node {
    T value{};
    std::atomic<std::uint32_t> references{1};
  };
  Node* node_;  ///< null only after a move
};

}  // namespace fastloop
