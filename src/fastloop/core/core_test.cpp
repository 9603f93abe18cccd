#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/core/ids.hpp"
#include "fastloop/core/timing.hpp"

namespace fastloop {
namespace {

TEST(Id, DefaultIsInvalidAndIdsOrderByValue) {
  EXPECT_FALSE(KeyframeId{}.valid());
  EXPECT_TRUE(KeyframeId{0}.valid());
  EXPECT_LT(KeyframeId{1}, KeyframeId{2});
  EXPECT_EQ(std::hash<LandmarkId>{}(LandmarkId{7}), std::hash<LandmarkId>{}(LandmarkId{7}));
}

TEST(InputError, NamesFileLineKeyAndExpectation) {
  const InputError e({"cam.yaml", 12, "fx"}, "is not a number", "a positive number, pixels");
  EXPECT_STREQ(e.what(), "cam.yaml:12: fx: is not a number (expected a positive number, pixels)");
  EXPECT_STREQ(InputError({"", 0, ""}, "no data").what(), "no data");
}

TEST(StageStatistics, PercentilesAreNearestRank) {
  std::vector<double> samples;
  for (int i = 100; i >= 1; --i) samples.push_back(i);
  const StageStatistics s = summarize(samples);
  EXPECT_EQ(s.count, 100u);
  EXPECT_DOUBLE_EQ(s.p50_ms, 50);
  EXPECT_DOUBLE_EQ(s.p95_ms, 95);
  EXPECT_DOUBLE_EQ(s.p99_ms, 99);
  EXPECT_DOUBLE_EQ(s.max_ms, 100);
  EXPECT_DOUBLE_EQ(s.mean_ms, 50.5);
  EXPECT_EQ(summarize({}).count, 0u);
  EXPECT_DOUBLE_EQ(summarize({3.0}).p99_ms, 3.0);
}

}  // namespace
}  // namespace fastloop
