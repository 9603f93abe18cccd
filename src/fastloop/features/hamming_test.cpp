#include "fastloop/features/hamming.hpp"

#include <gtest/gtest.h>

#include <bit>
#include <random>

namespace fastloop {
namespace {

Descriptor random_descriptor(std::mt19937_64& rng) {
  Descriptor d;
  for (auto& w : d.words) w = rng();
  return d;
}

int count_bit_by_bit(const Descriptor& a, const Descriptor& b) {
  int d = 0;
  for (int i = 0; i < 256; ++i)
    d += ((a.words[i / 64] >> (i % 64)) & 1) != ((b.words[i / 64] >> (i % 64)) & 1);
  return d;
}

TEST(Hamming, EqualsACountBitByBit) {
  std::mt19937_64 rng(1);
  for (int k = 0; k < 200; ++k) {
    const Descriptor a = random_descriptor(rng), b = random_descriptor(rng);
    EXPECT_EQ(hamming_distance(a, b), count_bit_by_bit(a, b));
  }
  Descriptor all;
  all.words.fill(~0ULL);
  EXPECT_EQ(hamming_distance(all, Descriptor{}), 256);
  EXPECT_EQ(hamming_distance(all, all), 0);
}

TEST(Hamming, BatchEqualsPortableForm) {
  std::mt19937_64 rng(2);
  std::vector<Descriptor> candidates(500);
  for (auto& c : candidates) c = random_descriptor(rng);
  candidates[0].words.fill(0);
  candidates[1].words.fill(~0ULL);
  for (const std::size_t n : {0u, 1u, 3u, 8u, 500u}) {
    std::vector<std::uint16_t> indices(n);
    for (auto& i : indices) i = static_cast<std::uint16_t>(rng() % candidates.size());
    for (const Descriptor& query : {candidates[0], candidates[7], random_descriptor(rng)}) {
      std::vector<std::uint16_t> ours(n), expected(n);
      hamming_distances(query, candidates.data(), indices, ours.data());
      reference::hamming_distances(query, candidates.data(), indices, expected.data());
      EXPECT_EQ(ours, expected);
      for (std::size_t k = 0; k < n; ++k)
        EXPECT_EQ(ours[k], count_bit_by_bit(query, candidates[indices[k]]));
      const NearestDescriptor a = nearest_descriptor(query, candidates.data(), indices);
      const NearestDescriptor b = reference::nearest_descriptor(query, candidates.data(), indices);
      EXPECT_EQ(a.position, b.position);
      EXPECT_EQ(a.distance, b.distance);
      EXPECT_EQ(a.second_distance, b.second_distance);
    }
  }
}

TEST(Hamming, NearestInRunsIsThatOfTheReference) {
  std::mt19937_64 rng(5);
  std::vector<Descriptor> candidates(200), queries(40);
  for (Descriptor& d : candidates) d = random_descriptor(rng);
  for (Descriptor& d : queries) d = random_descriptor(rng);
  candidates[31] = candidates[30];
  queries[0] = candidates[30];
  std::vector<DescriptorRun> runs(queries.size());
  for (DescriptorRun& r : runs) {
    r.begin = static_cast<std::uint32_t>(rng() % 190);
    r.end = r.begin + static_cast<std::uint32_t>(rng() % 11);
  }
  runs[0] = {20, 40};
  runs[1] = {7, 7};
  std::vector<std::uint32_t> ours(queries.size(), 999), expected(queries.size(), 999);
  nearest_in_runs(queries, candidates.data(), runs, ours.data());
  reference::nearest_in_runs(queries, candidates.data(), runs, expected.data());
  EXPECT_EQ(ours, expected);
  EXPECT_EQ(ours[0], 30u);
  EXPECT_EQ(ours[1], 999u);
}

TEST(Hamming, NearestTakesTheFirstOfEqualsAndCountsItsTwinAsSecond) {
  std::mt19937_64 rng(3);
  const Descriptor query = random_descriptor(rng);
  Descriptor near = query;
  near.words[2] ^= 0b111;
  const std::vector<Descriptor> candidates{random_descriptor(rng), near, near,
                                           random_descriptor(rng)};
  const NearestDescriptor best = nearest_descriptor(query, candidates);
  EXPECT_EQ(best.position, 1);
  EXPECT_EQ(best.distance, 3);
  EXPECT_EQ(best.second_distance, 3);

  std::vector<std::uint16_t> distances(candidates.size());
  hamming_distances(query, candidates, distances.data());
  EXPECT_EQ(distances[2], 3);

  const NearestDescriptor none = nearest_descriptor(query, std::span<const Descriptor>{});
  EXPECT_EQ(none.position, -1);
  EXPECT_EQ(none.distance, NearestDescriptor::kNoDistance);
}

}  // namespace
}  // namespace fastloop
