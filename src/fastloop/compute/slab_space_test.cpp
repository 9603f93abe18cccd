#include "fastloop/compute/slab_space.hpp"

#include <gtest/gtest.h>

#include <random>

namespace fastloop {
namespace {

TEST(SlabSpace, HandsOutWholeSlabAndNoMore) {
  SlabSpace space;
  EXPECT_FALSE(space.take(1));
  space.add_slab(1024);
  for (std::size_t i = 0; i < 4; ++i) {
    const auto block = space.take(200);
    ASSERT_TRUE(block);
    EXPECT_EQ(block->offset, 256 * i);
    EXPECT_EQ(block->bytes, 256u);
  }
  EXPECT_FALSE(space.take(1));
  EXPECT_EQ(space.bytes_taken(), 1024u);
  EXPECT_EQ(space.add_slab(512), 1u);
  EXPECT_EQ(space.take(512)->slab, 1u);
  EXPECT_EQ(space.bytes_reserved(), 1536u);
}

TEST(SlabSpace, NeighbouringGapsBecomeOne) {
  SlabSpace space;
  space.add_slab(1024);
  SlabSpace::Block block[4];
  for (auto& b : block) b = *space.take(256);
  space.give_back(block[0]);
  space.give_back(block[2]);
  EXPECT_FALSE(space.take(512));
  space.give_back(block[1]);  // joins both sides
  EXPECT_EQ(space.take(768)->offset, 0u);
}

TEST(SlabSpace, BlocksNeverOverlap) {
  std::mt19937 rng(1);
  SlabSpace space;
  std::vector<SlabSpace::Block> live;
  std::size_t taken = 0, largest = 0;
  for (int step = 0; step < 5000; ++step) {
    if (rng() % 5 < 3 || live.empty()) {
      const std::size_t bytes = 1 + rng() % 5000;
      auto block = space.take(bytes);
      if (!block) {
        space.add_slab(1 << 16);
        block = space.take(bytes);
      }
      ASSERT_TRUE(block);
      ASSERT_GE(block->bytes, bytes);
      for (const auto& o : live)
        ASSERT_TRUE(o.slab != block->slab || o.offset + o.bytes <= block->offset ||
                    block->offset + block->bytes <= o.offset);
      taken += block->bytes;
      live.push_back(*block);
    } else {
      std::swap(live[rng() % live.size()], live.back());
      taken -= live.back().bytes;
      space.give_back(live.back());
      live.pop_back();
    }
    ASSERT_EQ(space.bytes_taken(), taken);
    largest = std::max(largest, taken);
  }
  EXPECT_LE(space.bytes_reserved(), 2 * largest);
  for (const auto& b : live) space.give_back(b);
  EXPECT_EQ(space.bytes_taken(), 0u);
  EXPECT_EQ(space.take(1 << 16)->bytes, 1u << 16);  // everything is one gap again
}

}  // namespace
}  // namespace fastloop
