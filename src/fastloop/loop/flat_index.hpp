#pragma once

#include <cstdint>
#include <vector>

namespace fastloop::loop {

/// Numbers things by their ids in the order in which they come: a hash table in two arrays.
class FlatIndex {
 public:
  explicit FlatIndex(std::size_t expected) {
    std::size_t slots = 16;
    while (slots < 2 * expected) slots *= 2;
    slots_.assign(slots, kEmpty);
  }
  std::size_t size() const { return keys_.size(); }
  std::uint32_t key(std::size_t index) const { return keys_[index]; }

  /// Number of an id; the next free one, size() before the call, when it is new.
  std::uint32_t number_of(std::uint32_t id) {
    if (2 * keys_.size() >= slots_.size()) grow();
    std::uint32_t& slot = slot_of(id);
    if (slot == kEmpty) {
      slot = static_cast<std::uint32_t>(keys_.size());
      keys_.push_back(id);
    }
    return slot;
  }

 private:
  static constexpr std::uint32_t kEmpty = 0xffffffffu;

  std::uint32_t& slot_of(std::uint32_t id) {
    // Multiplicative hashing (Knuth) spreads neighbouring ids.
    const std::size_t mask = slots_.size() - 1;
    std::size_t at = (id * 0x9e3779b97f4a7c15ULL >> 32) & mask;
    while (slots_[at] != kEmpty && keys_[slots_[at]] != id) at = (at + 1) & mask;
    return slots_[at];
  }
  void grow() {
    slots_.assign(2 * slots_.size(), kEmpty);
    for (std::uint32_t i = 0; i < keys_.size(); ++i) slot_of(keys_[i]) = i;
  }

  std::vector<std::uint32_t> slots_;  ///< a power of two, at most half full
  std::vector<std::uint32_t> keys_;
};

}  // namespace fastloop::loop
