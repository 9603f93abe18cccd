#include "fastloop/place/candidate_ranking.hpp"

#include <gtest/gtest.h>

#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::place {
namespace {

/// Keyframes that show 5, 30, 0, 30 and 12 of the things in the query image.
class CandidateRanking : public ::testing::Test {
 protected:
  CandidateRanking() {
    std::mt19937 rng(1);
    std::vector<Descriptor> things;
    for (int i = 0; i < 40; ++i) things.push_back(matching::testing::random_descriptor(rng));
    for (const Descriptor& d : things) matching::testing::add_keypoint(query_, 10, 10, 0, d);
    for (const int shown : shown_) {
      FeatureSet& f = keyframes_.emplace_back();
      for (int i = 0; i < shown; ++i)
        matching::testing::add_keypoint(f, 10, 10, 0,
                                        matching::testing::with_flipped_bits(things[i], 10, rng));
      const auto id = static_cast<std::uint32_t>(keyframes_.size() - 1);
      candidates_.push_back({KeyframeId(id), 0.1f, 0.1f, 10});
    }
  }

  std::vector<RankedCandidate> rank(const Executor& executor, int max_candidates) const {
    RankingOptions options;
    options.max_candidates = max_candidates;
    const auto side_of = [this](KeyframeId id) {
      return matching::MatchSide{&keyframes_[id.value()], nullptr, {}};
    };
    return rank_by_matches(executor, {&query_, nullptr, {}}, candidates_, side_of, options);
  }

  const std::vector<int> shown_{5, 30, 0, 30, 12};
  FeatureSet query_;
  std::vector<FeatureSet> keyframes_;
  std::vector<PlaceCandidate> candidates_;
};

TEST_F(CandidateRanking, MostMatchesFirstTiesInTheGivenOrder) {
  const auto ranked = rank(Executor::cpu(), 10);
  EXPECT_EQ(ranked, rank(Executor::reference(), 10));
  ASSERT_EQ(ranked.size(), 5u);
  const std::vector<std::uint32_t> order{1, 3, 4, 0, 2};
  for (std::size_t i = 0; i < order.size(); ++i) {
    EXPECT_EQ(ranked[i].candidate, candidates_[order[i]]);
    EXPECT_EQ(ranked[i].matches, shown_[order[i]]);
  }
}

TEST_F(CandidateRanking, LooksAtTheFirstOnly) {
  const auto ranked = rank(Executor::cpu(), 3);
  ASSERT_EQ(ranked.size(), 3u);
  EXPECT_EQ(ranked[0].candidate.keyframe, KeyframeId(1));
  EXPECT_EQ(ranked[2].candidate.keyframe, KeyframeId(2));
  EXPECT_TRUE(rank(Executor::cpu(), 0).empty());
}

}  // namespace
}  // namespace fastloop::place
