#include "fastloop/matching/descriptor_matching.hpp"

#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/candidate_lists.hpp"
#include "fastloop/matching/claims.hpp"
#include "fastloop/matching/rotation_histogram.hpp"

namespace fastloop::matching {
namespace {

constexpr std::size_t kGrain = 32;  // keypoints worth a task
constexpr int kBatch = 128;

template <class Distances>
MatchKey nearest(const Descriptor& query, const Descriptor* all,
                 std::span<const std::uint16_t> candidates, const DescriptorMatchOptions& options) {
  std::uint16_t distance[kBatch];
  BestTwo found;
  for (std::size_t begin = 0; begin < candidates.size(); begin += kBatch) {
    const int n = static_cast<int>(std::min<std::size_t>(kBatch, candidates.size() - begin));
    Distances{}(query, all, candidates.data() + begin, n, distance);
    for (int j = 0; j < n; ++j)
      found.take(static_cast<MatchKey>(distance[j]) << 16 | candidates[begin + j]);
  }
  if (found.best == kNoKey || key_distance(found.best) > options.max_distance) return kNoKey;
  if (options.best_to_second < 1 && found.second != kNoKey &&
      !(static_cast<float>(key_distance(found.best)) <
        options.best_to_second * static_cast<float>(key_distance(found.second))))
    return kNoKey;
  return found.best;
}

template <class Distances>
void match_all(const Executor& executor, const MatchSide& first, const MatchSide& second,
               const CandidateLists& lists, const DescriptorMatchOptions& options,
               std::vector<MatchKey>& keys) {
  executor.for_ranges(keys.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      keys[i] = nearest<Distances>(first.features->descriptors[i],
                                   second.features->descriptors.data(), lists.of(i), options);
  });
}

}  // namespace

std::vector<std::int32_t> match_descriptors(const Executor& executor, const MatchSide& first,
                                            const MatchSide& second,
                                            const DescriptorMatchOptions& options) {
  const CandidateLists lists(first, second);
  std::vector<MatchKey> keys(first.features->size(), kNoKey);
  if (executor.kind() == Executor::Kind::kReference)
    match_all<PortableDistances>(executor, first, second, lists, options, keys);
  else
    match_all<CpuDistances>(executor, first, second, lists, options, keys);
  std::vector<std::int32_t> matches(keys.size());
  resolve_claims(keys, second.features->size(), matches, {});
  if (options.check_rotation)
    drop_odd_rotations(first.features->angle_rad, second.features->angle_rad, matches);
  return matches;
}

}  // namespace fastloop::matching
