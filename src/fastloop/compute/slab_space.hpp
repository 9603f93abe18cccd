#pragma once

#include <cstddef>
#include <map>
#include <optional>
#include <vector>

namespace fastloop {

/// Book-keeping of memory that is taken in slabs and handed out in blocks; knows numbers only, not
/// where the memory lies. Slabs stay where they are and are never given back, so a block keeps its
/// place while others come and go. Not synchronised.
class SlabSpace {
 public:
  struct Block {
    std::size_t slab = 0, offset = 0, bytes = 0;
  };
  static constexpr std::size_t kAlignment = 256;

  /// Space in the lowest place that is large enough, `bytes` rounded up to the alignment.
  std::optional<Block> take(std::size_t bytes);
  /// What take() returned, once.
  void give_back(const Block& block);
  /// @return number of the new slab, whose memory the caller holds
  std::size_t add_slab(std::size_t bytes);

  std::size_t slabs() const { return slabs_.size(); }
  std::size_t bytes_reserved() const { return reserved_; }
  std::size_t bytes_taken() const { return taken_; }
  static std::size_t rounded(std::size_t bytes);

 private:
  using Free = std::map<std::size_t, std::size_t>;  ///< offset of a gap, its length; never adjacent
  std::vector<Free> slabs_;
  std::size_t reserved_ = 0, taken_ = 0;
};

}  // namespace fastloop
