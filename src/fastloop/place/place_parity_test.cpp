#include <gtest/gtest.h>

#include <algorithm>
#include <map>

#include "fastloop/compute/executors_for_tests.hpp"
#include "fastloop/matching/scene_for_tests.hpp"
#include "fastloop/place/candidate_ranking.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/place/place_database.hpp"

/// Place recognition with all executors: words, candidates and their order, on generated images.
/// The index itself is held against brute force in inverted_index_test.cpp.
namespace fastloop::place {
namespace {

using matching::testing::random_descriptor;
using matching::testing::with_flipped_bits;

/// Images of a few places: those of one place share most of what they show.
class Images {
 public:
  explicit Images(unsigned seed) : rng_(seed) {
    for (int place = 0; place < 4; ++place) {
      auto& looks = looks_.emplace_back();
      for (int i = 0; i < 60; ++i) looks.push_back(random_descriptor(rng_));
    }
  }
  /// `keypoints` of them: many show what others of the place show, some the very same bits.
  FeatureSet draw(int keypoints) {
    FeatureSet f;
    const auto& looks = looks_[rng_() % looks_.size()];
    for (int i = 0; i < keypoints; ++i) {
      Descriptor d = looks[rng_() % looks.size()];
      if (rng_() % 4 != 0) d = with_flipped_bits(d, static_cast<int>(rng_() % 30), rng_);
      if (rng_() % 6 == 0) d = random_descriptor(rng_);
      matching::testing::add_keypoint(f, 10, 10, 0, d, 0.1f * static_cast<float>(rng_() % 60));
    }
    return f;
  }
  unsigned number(unsigned below) { return static_cast<unsigned>(rng_() % below); }

 private:
  std::mt19937 rng_;
  std::vector<std::vector<Descriptor>> looks_;
};

TEST(PlaceParity, WordsAreTheSameWithAllExecutors) {
  const Vocabulary& vocabulary = default_vocabulary();
  std::size_t words = 0;
  for (unsigned seed = 0; seed < 200; ++seed) {
    Images images(seed);
    static constexpr int kSizes[] = {0, 1, 2, 50, 300, 1500};
    const FeatureSet f = images.draw(kSizes[seed % 6]);
    const BagOfWords a = vocabulary.transform(f.descriptors, Executor::reference());
    for (const Executor& executor : fastloop::testing::parallel_executors()) {
      const BagOfWords b = vocabulary.transform(f.descriptors, executor);
      ASSERT_EQ(a.vector.word, b.vector.word) << seed;
      ASSERT_EQ(a.vector.weight, b.vector.weight) << seed;
      ASSERT_EQ(a.groups.node, b.groups.node) << seed;
      ASSERT_EQ(a.groups.start, b.groups.start) << seed;
      ASSERT_EQ(a.groups.indices, b.groups.indices) << seed;
    }
    // One descriptor at a time says the same.
    for (std::size_t i = 0; i < f.size(); i += 97)
      EXPECT_TRUE(std::binary_search(a.vector.word.begin(), a.vector.word.end(),
                                     vocabulary.word_of(f.descriptors[i])));
    words += a.vector.word.size();
  }
  EXPECT_GT(words, 10'000u);
}

TEST(PlaceParity, CandidatesAndTheirOrder) {
  const Vocabulary& vocabulary = default_vocabulary();
  int situations = 0, candidates = 0, ties = 0;
  for (unsigned seed = 0; seed < 40; ++seed) {
    Images images(seed + 500);
    std::map<Executor::Kind, PlaceDatabase> databases;
    for (const Executor& e : fastloop::testing::all_executors())
      databases.try_emplace(e.kind(), vocabulary);
    std::vector<FeatureSet> features;
    const unsigned count = seed % 8 == 0 ? seed % 3 : 12;
    for (std::uint32_t k = 0; k < count; ++k) {
      features.push_back(k > 0 && k % 5 == 0 ? features.back()  // the same image twice: ties
                                             : images.draw(static_cast<int>(images.number(200))));
      for (const Executor& e : fastloop::testing::all_executors()) {
        PlaceDatabase& d = databases.at(e.kind());
        d.insert(KeyframeId(k), d.words_of(features.back().descriptors, e));
      }
    }
    for (int trial = 0; trial < 6; ++trial, ++situations) {
      const FeatureSet query = images.draw(static_cast<int>(images.number(300)));
      std::vector<KeyframeId> excluded;
      if (count > 0 && trial % 2) excluded.emplace_back(images.number(count));
      std::vector<std::vector<RankedCandidate>> ranked;
      std::vector<std::vector<PlaceCandidate>> found;
      for (const Executor& e : fastloop::testing::all_executors()) {
        const PlaceDatabase& d = databases.at(e.kind());
        const PlaceDatabase::Words words = d.words_of(query.descriptors, e);
        QueryOptions options;
        options.min_shared_ratio = trial % 3 ? kSharedRatioBeforeRanking : 0;
        const auto neighbours = [&](KeyframeId id) {
          return std::vector<KeyframeId>{KeyframeId(id.value() + 1), KeyframeId(id.value() / 2)};
        };
        found.push_back(d.query(words->vector, excluded, neighbours, options));
        RankingOptions ranking;
        ranking.max_candidates = trial == 0 ? 3 : 20;
        const auto side_of = [&](KeyframeId id) {
          return matching::MatchSide{&features[id.value()], &d.words(id)->groups, {}};
        };
        ranked.push_back(
            rank_by_matches(e, {&query, &words->groups, {}}, found.back(), side_of, ranking));
      }
      SCOPED_TRACE(::testing::Message() << "seed " << seed << " trial " << trial);
      for (std::size_t e = 1; e < found.size(); ++e) {
        ASSERT_EQ(found[0], found[e]);
        ASSERT_EQ(ranked[0], ranked[e]);
      }
      candidates += static_cast<int>(found[0].size());
      for (std::size_t i = 1; i < found[0].size(); ++i)
        ties += found[0][i].score == found[0][i - 1].score;
      for (std::size_t i = 1; i < ranked[0].size(); ++i)
        EXPECT_GE(ranked[0][i - 1].matches, ranked[0][i].matches);
    }
  }
  EXPECT_GE(situations, 200);
  EXPECT_GT(candidates, 400);
  EXPECT_GT(ties, 10);
}

}  // namespace
}  // namespace fastloop::place
