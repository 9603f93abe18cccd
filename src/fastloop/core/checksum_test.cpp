#include "fastloop/core/checksum.hpp"

#include <gtest/gtest.h>

#include <string>

namespace fastloop {
namespace {

std::uint64_t of(const std::string& text, std::uint64_t previous = 0) {
  return crc64(std::as_bytes(std::span(text)), previous);
}

TEST(Crc64, PublishedCheckValue) {
  EXPECT_EQ(of("123456789"), 0x995DC9BBDF1939FAull);
  EXPECT_EQ(of(""), 0u);
}

TEST(Crc64, CanBeContinuedAnywhere) {
  const std::string text = "a text that is longer than two words of eight bytes";
  for (std::size_t cut = 0; cut <= text.size(); ++cut)
    EXPECT_EQ(of(text.substr(cut), of(text.substr(0, cut))), of(text)) << cut;
}

TEST(Crc64, EveryFlippedBitIsSeen) {
  const std::string text(100, 'x');
  for (std::size_t bit = 0; bit < 8 * text.size(); ++bit) {
    std::string other = text;
    other[bit / 8] = static_cast<char>(other[bit / 8] ^ (1 << (bit % 8)));
    EXPECT_NE(of(other), of(text)) << bit;
  }
}

}  // namespace
}  // namespace fastloop
