#include "fastloop/io/text.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace fastloop::io {
namespace {

TEST(Text, NumbersAreReadWholeOrNotAtAll) {
  EXPECT_EQ(parse_number("1.5"), 1.5);
  EXPECT_EQ(parse_number(" -2e-3\r"), -2e-3);
  EXPECT_EQ(parse_number("+7."), 7.0);
  EXPECT_TRUE(std::isnan(*parse_number("NaN")));
  EXPECT_TRUE(std::isnan(*parse_number(".nan")));
  EXPECT_TRUE(std::isinf(*parse_number("-inf")));
  for (const char* wrong :
       {"", " ", "1.5x", "x", "1 2", "1,5", "--1", "+-1", "0x10", "1e999", "1e"})
    EXPECT_FALSE(parse_number(wrong)) << wrong;
}

TEST(Text, StampsAreExactBeyondTheDigitsOfADouble) {
  EXPECT_EQ(parse_nanoseconds("1403715274312143104.0000000000"), 1403715274312143104);
  EXPECT_EQ(parse_nanoseconds("1403715274312143105"), 1403715274312143105);
  EXPECT_EQ(parse_seconds("1403715273.262142977"), 1403715273262142977);
  EXPECT_EQ(parse_seconds("1403715273.26214297799"), 1403715273262142977);
  EXPECT_EQ(parse_seconds("0.033333"), 33333000);
  EXPECT_EQ(parse_seconds("7"), 7'000'000'000);
  EXPECT_EQ(parse_seconds("1.036224e-01"), 103622400);
  for (const char* wrong :
       {"", "-1", "a", "1.2.3", "nan", "inf", "99999999999999999999", "1e40", ".", "1 2"})
    EXPECT_FALSE(parse_seconds(wrong)) << wrong;
  for (const char* wrong : {"", "-1", "a", "1e18", "99999999999999999999", ".5"})
    EXPECT_FALSE(parse_nanoseconds(wrong)) << wrong;
}

}  // namespace
}  // namespace fastloop::io
