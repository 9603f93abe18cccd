#pragma once

#include <functional>
#include <span>
#include <vector>

#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/place/inverted_index.hpp"

namespace fastloop::place {

/// QueryOptions::min_shared_ratio for a query whose candidates are ranked afterwards: it may let
/// more through than the published 0.8.
inline constexpr float kSharedRatioBeforeRanking = 0.6f;

struct RankingOptions {
  int max_candidates = 20;  ///< how many of the query's candidates are looked at
  matching::DescriptorMatchOptions matching;
};

struct RankedCandidate {
  PlaceCandidate candidate;
  int matches = 0;  ///< descriptor matches of the query image with candidate.keyframe
  bool operator==(const RankedCandidate&) const = default;
};

/// Puts the first candidates of a query in the order of their descriptor matches with the query
/// image. Words say little when keyframes are few or the vocabulary is strange to the place; the
/// descriptors themselves say much more.
///
/// @param candidates  as InvertedIndex::query returns them; for loops and merges apart, of one map
/// @param side_of     features, groups and mask of a keyframe
/// @return min(max_candidates, candidates.size()) entries, most matches first; ties: the given
/// order
std::vector<RankedCandidate> rank_by_matches(
    const Executor& executor, const matching::MatchSide& query,
    std::span<const PlaceCandidate> candidates,
    const std::function<matching::MatchSide(KeyframeId)>& side_of,
    const RankingOptions& options = {});

}  // namespace fastloop::place
