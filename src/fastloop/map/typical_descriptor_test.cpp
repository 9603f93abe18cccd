#include "fastloop/map/typical_descriptor.hpp"

#include <gtest/gtest.h>

#include <random>

namespace fastloop::map {
namespace {

Descriptor random_descriptor(std::mt19937_64& random, int bits) {
  Descriptor d;
  for (int i = 0; i < bits; ++i) {
    const std::uint64_t bit = random() % 256;
    d.words[bit / 64] |= std::uint64_t{1} << bit % 64;
  }
  return d;
}

TEST(TypicalDescriptor, IsThatOfThePublishedWay) {
  std::mt19937_64 random(7);
  for (int trial = 0; trial < 400; ++trial) {
    // Few bits make ties, many make none.
    const int bits = 1 + trial % 40;
    std::vector<Descriptor> d(1 + random() % kMaxVoters);
    for (Descriptor& x : d) x = random_descriptor(random, bits);
    EXPECT_EQ(typical_descriptor(d), reference::typical_descriptor(d)) << d.size() << ' ' << bits;
  }
}

TEST(TypicalDescriptor, StandsInTheMiddleOfTheOthers) {
  std::vector<Descriptor> d(5);
  const std::size_t bits[] = {0, 14, 20, 26, 60};
  for (std::size_t i = 0; i < 5; ++i)
    for (std::size_t bit = 0; bit < bits[i]; ++bit) d[i].words[0] |= std::uint64_t{1} << bit;
  EXPECT_EQ(typical_descriptor(d), 2u);
}

}  // namespace
}  // namespace fastloop::map
