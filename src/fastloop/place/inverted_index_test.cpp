#include "fastloop/place/inverted_index.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <map>
#include <random>
#include <set>

#include "fastloop/core/error.hpp"
#include "fastloop/place/vocabulary.hpp"

namespace fastloop::place {
namespace {

constexpr std::size_t kWords = 500;

KeyframeId id(std::uint32_t value) {
  return KeyframeId(value);
}

const InvertedIndex::Covisibles kAlone = [](KeyframeId) { return std::vector<KeyframeId>(); };

/// Normalised vector with the given words.
BowVector bow_of(const std::set<std::uint32_t>& words, std::mt19937* rng = nullptr) {
  BowVector bow;
  double sum = 0;
  for (const std::uint32_t w : words) {
    bow.word.push_back(w);
    bow.weight.push_back(rng ? 1 + static_cast<float>((*rng)() % 5) : 1.0f);
    sum += bow.weight.back();
  }
  for (float& w : bow.weight) w = static_cast<float>(w / sum);
  return bow;
}

BowVector random_bow(std::mt19937& rng) {
  std::set<std::uint32_t> words;
  const unsigned place = rng() % 10;
  for (int i = 0; i < 40; ++i) words.insert(rng() % 3 ? place * 50 + rng() % 50 : rng() % kWords);
  return bow_of(words, &rng);
}

/// The query again, from the text of the header, over plain maps.
std::vector<PlaceCandidate> brute_force(const std::map<KeyframeId, BowVector>& keyframes,
                                        const BowVector& bow, const std::set<KeyframeId>& excluded,
                                        const InvertedIndex::Covisibles& covisibles) {
  std::map<KeyframeId, int> shared;
  int most = 0;
  for (const auto& [k, other] : keyframes) {
    if (excluded.contains(k)) continue;
    std::vector<std::uint32_t> common;
    std::set_intersection(bow.word.begin(), bow.word.end(), other.word.begin(), other.word.end(),
                          std::back_inserter(common));
    if (common.empty()) continue;
    shared[k] = static_cast<int>(common.size());
    most = std::max(most, shared[k]);
  }
  std::map<KeyframeId, PlaceCandidate> best;
  for (const auto& [k, count] : shared) {
    if (!(static_cast<float>(count) > 0.8f * static_cast<float>(most))) continue;
    std::set<KeyframeId> group{k};
    for (const KeyframeId n : covisibles(k)) group.insert(n);
    PlaceCandidate c;
    for (const KeyframeId member : group) {
      if (!shared.contains(member)) continue;
      const float score = l1_score(bow, keyframes.at(member));
      c.group_score += score;
      if (!c.keyframe.valid() || score > c.score)
        c.keyframe = member, c.score = score, c.shared_words = shared[member];
    }
    PlaceCandidate& kept = best[c.keyframe];
    if (!kept.keyframe.valid() || c.group_score > kept.group_score) kept = c;
  }
  std::vector<PlaceCandidate> result;
  for (const auto& [k, c] : best) result.push_back(c);
  std::stable_sort(result.begin(), result.end(),
                   [](const auto& a, const auto& b) { return a.group_score > b.group_score; });
  return result;
}

TEST(InvertedIndex, EqualsBruteForceThroughInsertionsAndErasures) {
  std::mt19937 rng(1);
  InvertedIndex index(kWords);
  std::map<KeyframeId, BowVector> keyframes;
  std::map<KeyframeId, std::vector<KeyframeId>> neighbours;
  const InvertedIndex::Covisibles covisibles = [&](KeyframeId k) { return neighbours[k]; };
  int candidates = 0;
  for (std::uint32_t step = 0; step < 600; ++step) {
    if (rng() % 4 == 0 && !keyframes.empty()) {
      const KeyframeId victim = std::next(keyframes.begin(), rng() % keyframes.size())->first;
      EXPECT_TRUE(index.erase(victim));
      EXPECT_FALSE(index.contains(victim));
      keyframes.erase(victim);
    } else {
      const BowVector bow = random_bow(rng);
      index.insert(id(step), bow);
      keyframes[id(step)] = bow;
      // Neighbours may be unknown to the index, named twice, or the keyframe itself.
      for (int i = 0; i < 10; ++i) neighbours[id(step)].push_back(id(rng() % (step + 5)));
    }
    ASSERT_EQ(index.size(), keyframes.size());
    if (step % 3 != 0) continue;
    std::set<KeyframeId> excluded;
    for (int i = 0; i < 8; ++i) excluded.insert(id(rng() % (step + 3)));
    const BowVector bow = random_bow(rng);
    const std::vector<KeyframeId> list(excluded.begin(), excluded.end());
    const auto found = index.query(bow, list, covisibles);
    ASSERT_EQ(found, brute_force(keyframes, bow, excluded, covisibles)) << step;
    candidates += static_cast<int>(found.size());
  }
  EXPECT_GT(candidates, 300);
}

TEST(InvertedIndex, ResultDoesNotDependOnTheOrderOfInsertion) {
  std::mt19937 rng(2);
  std::vector<BowVector> bows;
  for (int i = 0; i < 80; ++i) bows.push_back(random_bow(rng));
  InvertedIndex forward(kWords), backward(kWords);
  for (std::uint32_t i = 0; i < 80; ++i) {
    forward.insert(id(i), bows[i]);
    backward.insert(id(79 - i), bows[79 - i]);
  }
  for (const BowVector& bow : bows)
    EXPECT_EQ(forward.query(bow, {}, kAlone), backward.query(bow, {}, kAlone));
}

TEST(InvertedIndex, SharedWordGate) {
  // The query has 10 words; the best keyframe shares all of them, so more than 8 are asked for.
  std::set<std::uint32_t> words;
  for (std::uint32_t w = 0; w < 10; ++w) words.insert(w);
  const BowVector query = bow_of(words);
  InvertedIndex index(kWords);
  for (std::uint32_t shared = 7; shared <= 10; ++shared) {
    std::set<std::uint32_t> own;
    for (std::uint32_t w = 0; w < 10; ++w) own.insert(w < shared ? w : 100 * shared % 400 + 50 + w);
    index.insert(id(shared), bow_of(own));
  }
  const auto ids = [&](std::span<const KeyframeId> excluded) {
    std::vector<std::uint32_t> result;
    for (const auto& c : index.query(query, excluded, kAlone)) result.push_back(c.keyframe.value());
    return result;
  };
  EXPECT_EQ(ids({}), (std::vector<std::uint32_t>{10, 9}));
  const std::vector<KeyframeId> best{id(10)};  // the gate then starts from 9 shared words
  EXPECT_EQ(ids(best), (std::vector<std::uint32_t>{9, 8}));
}

TEST(InvertedIndex, ANeighbourBelowTheGateCountsWithItsScoreForThisQuery) {
  InvertedIndex index(kWords);
  const BowVector query = bow_of({1, 2, 3, 4, 5, 6, 7, 8});
  const BowVector weak = bow_of({1, 2, 300, 301});
  index.insert(id(1), bow_of({1, 2, 3, 4, 5, 6, 7, 8}));
  index.insert(id(2), weak);
  index.insert(id(3), bow_of({400, 401}));
  const InvertedIndex::Covisibles all = [](KeyframeId) {
    return std::vector<KeyframeId>{id(2), id(3), id(99)};
  };
  index.query(bow_of({1, 2, 300, 301, 400}), {}, all);  // an earlier query leaves nothing behind
  const auto found = index.query(query, {}, all);
  ASSERT_EQ(found.size(), 1u);
  EXPECT_EQ(found[0].keyframe, id(1));
  EXPECT_FLOAT_EQ(found[0].group_score, 1 + l1_score(query, weak));
}

TEST(InvertedIndex, TiesTakeTheLowerId) {
  InvertedIndex index(kWords);
  const BowVector bow = bow_of({5, 6, 7});
  for (const std::uint32_t k : {30u, 10u, 20u}) index.insert(id(k), bow);
  const auto found = index.query(bow, {}, kAlone);
  ASSERT_EQ(found.size(), 3u);
  for (std::uint32_t i = 0; i < 3; ++i) EXPECT_EQ(found[i].keyframe, id(10 * (i + 1)));
  // As one group, 10 stands for all.
  const auto group = index.query(bow, {}, [](KeyframeId) {
    return std::vector<KeyframeId>{id(20), id(30), id(10)};
  });
  ASSERT_EQ(group.size(), 1u);
  EXPECT_EQ(group[0].keyframe, id(10));
  EXPECT_FLOAT_EQ(group[0].group_score, 3);
}

TEST(InvertedIndex, DegenerateInputs) {
  InvertedIndex index(kWords);
  EXPECT_TRUE(index.query(bow_of({1}), {}, kAlone).empty());
  EXPECT_FALSE(index.erase(id(0)));
  index.insert(id(0), {});
  EXPECT_TRUE(index.query(bow_of({1}), {}, kAlone).empty());
  EXPECT_TRUE(index.query({}, {}, kAlone).empty());
  EXPECT_THROW(index.insert(id(0), {}), InvalidArgument);
  EXPECT_THROW(index.insert(id(1), bow_of({kWords})), InvalidArgument);
  EXPECT_FALSE(index.contains(id(1)));
  EXPECT_THROW(index.query(bow_of({kWords}), {}, kAlone), InvalidArgument);
  EXPECT_TRUE(index.erase(id(0)));
  EXPECT_EQ(index.size(), 0u);
}

}  // namespace
}  // namespace fastloop::place
