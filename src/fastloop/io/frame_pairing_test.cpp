#include "fastloop/io/frame_pairing.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <set>

namespace fastloop::io {
namespace {

constexpr Nanoseconds kMs = 1'000'000;

TEST(FramePairing, DropsFramesWithoutPartner) {
  const std::vector<Nanoseconds> left{0, 50 * kMs, 100 * kMs, 150 * kMs};
  const std::vector<Nanoseconds> right{1 * kMs, 99 * kMs, 153 * kMs, 201 * kMs};
  const auto pairs = pair_by_time(left, right, 5 * kMs);
  ASSERT_EQ(pairs.size(), 3u);
  EXPECT_EQ(pairs[1].left, 2u);
  EXPECT_EQ(pairs[1].right, 1u);
  EXPECT_TRUE(pair_by_time(left, {}, 5 * kMs).empty());
  EXPECT_TRUE(pair_by_time({}, right, 5 * kMs).empty());
}

/// Against the definition, by brute force: i and j pair when no other stamp of either list is
/// nearer.
TEST(FramePairing, AgreesWithTheDefinitionOnRandomStamps) {
  std::mt19937 random(5);
  for (int round = 0; round < 200; ++round) {
    const auto make = [&] {
      std::set<Nanoseconds> stamps;
      const std::size_t count = random() % 30;
      while (stamps.size() < count) stamps.insert(static_cast<Nanoseconds>(random() % 200));
      return std::vector<Nanoseconds>(stamps.begin(), stamps.end());
    };
    const auto left = make(), right = make();
    const Nanoseconds tolerance = static_cast<Nanoseconds>(random() % 10);
    const auto pairs = pair_by_time(left, right, tolerance);
    std::set<std::size_t> left_used, right_used;
    for (std::size_t k = 0; k < pairs.size(); ++k) {
      const Nanoseconds distance = std::abs(left[pairs[k].left] - right[pairs[k].right]);
      EXPECT_LE(distance, tolerance);
      for (const Nanoseconds t : right) EXPECT_LE(distance, std::abs(left[pairs[k].left] - t));
      for (const Nanoseconds t : left) EXPECT_LE(distance, std::abs(right[pairs[k].right] - t));
      EXPECT_TRUE(left_used.insert(pairs[k].left).second);
      EXPECT_TRUE(right_used.insert(pairs[k].right).second);
      if (k > 0) {
        EXPECT_LT(pairs[k - 1].right, pairs[k].right);
      }
    }
    // Nothing that is strictly nearest on both sides may be missing.
    for (std::size_t i = 0; i < left.size(); ++i)
      for (std::size_t j = 0; j < right.size(); ++j) {
        const Nanoseconds d = std::abs(left[i] - right[j]);
        const auto nearer = [&](Nanoseconds from, Nanoseconds skip) {
          return [=](Nanoseconds t) { return t != skip && std::abs(from - t) <= d; };
        };
        if (d <= tolerance && std::none_of(right.begin(), right.end(), nearer(left[i], right[j])) &&
            std::none_of(left.begin(), left.end(), nearer(right[j], left[i]))) {
          EXPECT_TRUE(left_used.count(i)) << i;
        }
      }
  }
}

TEST(FramePairing, ToleranceNeverReachesTheNextFrame) {
  const std::vector<Nanoseconds> fast{0, 4 * kMs, 8 * kMs}, slow{0, 50 * kMs, 100 * kMs};
  EXPECT_EQ(pairing_tolerance_ns(slow, slow, 5 * kMs), 5 * kMs);
  EXPECT_EQ(pairing_tolerance_ns(slow, fast, 5 * kMs), 2 * kMs);
  const std::vector<Nanoseconds> single{0};
  EXPECT_EQ(pairing_tolerance_ns(single, single, 5 * kMs), 5 * kMs);
}

}  // namespace
}  // namespace fastloop::io
