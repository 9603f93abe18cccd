#include "fastloop/place/candidate_ranking.hpp"

#include <algorithm>

namespace fastloop::place {

std::vector<RankedCandidate> rank_by_matches(
    const Executor& executor, const matching::MatchSide& query,
    std::span<const PlaceCandidate> candidates,
    const std::function<matching::MatchSide(KeyframeId)>& side_of, const RankingOptions& options) {
  const auto limit = static_cast<std::size_t>(std::max(0, options.max_candidates));
  const std::size_t n = std::min(candidates.size(), limit);
  std::vector<matching::MatchSide> sides;
  for (std::size_t i = 0; i < n; ++i) sides.push_back(side_of(candidates[i].keyframe));
  const auto matches = matching::match_descriptors(executor, query, sides, options.matching);
  std::vector<RankedCandidate> ranked(n);
  const auto matched = [](std::int32_t k) { return k != matching::kNoMatch; };
  for (std::size_t i = 0; i < n; ++i)
    ranked[i] = {candidates[i],
                 static_cast<int>(std::count_if(matches[i].begin(), matches[i].end(), matched))};
  std::stable_sort(ranked.begin(), ranked.end(),
                   [](const auto& a, const auto& b) { return a.matches > b.matches; });
  return ranked;
}

}  // namespace fastloop::place
