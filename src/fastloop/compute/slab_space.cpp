#include "fastloop/compute/slab_space.hpp"

#include <algorithm>
#include <iterator>

namespace fastloop {

std::size_t SlabSpace::rounded(std::size_t bytes) {
  return (std::max<std::size_t>(bytes, 1) + kAlignment - 1) / kAlignment * kAlignment;
}

std::optional<SlabSpace::Block> SlabSpace::take(std::size_t bytes) {
  bytes = rounded(bytes);
  for (std::size_t s = 0; s < slabs_.size(); ++s)
    for (auto gap = slabs_[s].begin(); gap != slabs_[s].end(); ++gap) {
      const auto [offset, length] = *gap;
      if (length < bytes) continue;
      slabs_[s].erase(gap);
      if (length > bytes) slabs_[s].emplace(offset + bytes, length - bytes);
      taken_ += bytes;
      return Block{s, offset, bytes};
    }
  return std::nullopt;
}

void SlabSpace::give_back(const Block& block) {
  Free& gaps = slabs_[block.slab];
  auto gap = gaps.emplace(block.offset, block.bytes).first;
  if (const auto next = std::next(gap);
      next != gaps.end() && gap->first + gap->second == next->first) {
    gap->second += next->second;
    gaps.erase(next);
  }
  if (gap != gaps.begin())
    if (const auto before = std::prev(gap); before->first + before->second == gap->first) {
      before->second += gap->second;
      gaps.erase(gap);
    }
  taken_ -= block.bytes;
}

std::size_t SlabSpace::add_slab(std::size_t bytes) {
  bytes = bytes / kAlignment * kAlignment;
  slabs_.push_back({{0, bytes}});
  reserved_ += bytes;
  return slabs_.size() - 1;
}

}  // namespace fastloop
