#include "fastloop/place/candidate_ranking.hpp"

#include <algorithm>

namespace fastloop::place {

std::vector<RankedCandidate> rank_by_matches(
    const Executor& executor, const matching::MatchSide& query,
    std::span<const PlaceCandidate> candidates,
    const std::function<matching::MatchSide(KeyframeId)>& side_of, const RankingOptions& options) {
  const auto limit = static_cast<std::size_t>(std::max(0, options.max_candidates));
  const std::size_t n = std::min(candidates.size(), limit);
  std::vector<RankedCandidate> ranked(n);
  executor.for_ranges(n, 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const auto matches = matching::match_descriptors(
          executor, query, side_of(candidates[i].keyframe), options.matching);
      const auto matched = [](std::int32_t k) { return k != matching::kNoMatch; };
      ranked[i] = {candidates[i],
                   static_cast<int>(std::count_if(matches.begin(), matches.end(), matched))};
    }
  });
  std::stable_sort(ranked.begin(), ranked.end(),
                   [](const auto& a, const auto& b) { return a.matches > b.matches; });
  return ranked;
}

}  // namespace fastloop::place
