#include "fastloop/matching/descriptor_matching.hpp"

#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/candidate_lists.hpp"
#include "fastloop/matching/claims.hpp"
#include "fastloop/matching/descriptor_matching_cuda.hpp"
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
  return nearest_of(found, options.max_distance, options.best_to_second);
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

std::vector<std::int32_t> match_on_host(const Executor& executor, const MatchSide& first,
                                        const MatchSide& second,
                                        const DescriptorMatchOptions& options) {
  const CandidateLists lists(first, second);
  std::vector<MatchKey> keys(first.features->size(), kNoKey);
  if (executor.sequential())
    match_all<PortableDistances>(executor, first, second, lists, options, keys);
  else
    match_all<CpuDistances>(executor, first, second, lists, options, keys);
  std::vector<std::int32_t> matches(keys.size());
  resolve_claims(keys, second.features->size(), matches, {});
  return matches;
}

/// False where the host must do it.
bool match_on_device(const Executor& executor, const MatchSide& first,
                     std::span<const MatchSide> seconds, const DescriptorMatchOptions& options,
                     std::vector<std::vector<std::int32_t>>& matches) {
  if (!executor.cuda_session()) return false;
  const auto flat = [](const MatchSide& side) {
    check_side(side);
    make_feature_view(*side.features, {});
    return SideToMatch{side.features, side.groups,
                       side.keypoint_blocked.empty() ? nullptr : side.keypoint_blocked.data()};
  };
  DescriptorCall call{flat(first), {}, options.max_distance, options.best_to_second};
  for (const MatchSide& second : seconds) call.seconds.push_back(flat(second));
  std::vector<std::uint32_t> winner;
  if (!match_on_device(*executor.cuda_session(), call, winner)) return false;
  std::vector<std::size_t> start{0};
  for (const MatchSide& second : seconds) start.push_back(start.back() + second.features->size());
  executor.for_ranges(seconds.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin) {
      matches[begin].assign(first.features->size(), kNoMatch);
      for (std::size_t k = start[begin]; k < start[begin + 1]; ++k)
        if (winner[k] != kNoKey)
          matches[begin][static_cast<std::size_t>(key_index(winner[k]))] =
              static_cast<std::int32_t>(k - start[begin]);
    }
  });
  return true;
}

}  // namespace

std::vector<std::vector<std::int32_t>> match_descriptors(const Executor& executor,
                                                         const MatchSide& first,
                                                         std::span<const MatchSide> seconds,
                                                         const DescriptorMatchOptions& options) {
  std::vector<std::vector<std::int32_t>> matches(seconds.size());
  const bool done = match_on_device(executor, first, seconds, options, matches);
  executor.for_ranges(seconds.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin) {
      if (!done) matches[begin] = match_on_host(executor, first, seconds[begin], options);
      if (options.check_rotation)
        drop_odd_rotations(first.features->angle_rad, seconds[begin].features->angle_rad,
                           matches[begin]);
    }
  });
  return matches;
}

std::vector<std::int32_t> match_descriptors(const Executor& executor, const MatchSide& first,
                                            const MatchSide& second,
                                            const DescriptorMatchOptions& options) {
  return std::move(match_descriptors(executor, first, {&second, 1}, options).front());
}

}  // namespace fastloop::matching
