#include "fastloop/matching/descriptor_matching.hpp"

#include <cmath>

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

/// The other drop_odd_rotations for a list of the matches.
void drop_odd_rotations(std::span<const float> first_angle_rad,
                        std::span<const float> second_angle_rad, std::vector<MatchedPair>& pairs) {
  const auto bin = [&](const MatchedPair& p) {
    const float change = first_angle_rad[p.first] - second_angle_rad[p.second];
    return std::isfinite(change) ? RotationHistogram::bin(change) : -1;
  };
  RotationHistogram histogram;
  for (const MatchedPair& p : pairs)
    if (const int b = bin(p); b >= 0) histogram.add(b);
  const auto kept = histogram.kept();
  std::erase_if(pairs, [&](const MatchedPair& p) {
    const int b = bin(p);
    return b >= 0 && !kept[static_cast<std::size_t>(b)];
  });
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
  std::vector<std::vector<MatchedPair>> pairs;
  if (!match_on_device(*executor.cuda_session(), call, pairs)) return false;
  for (std::size_t s = 0; s < seconds.size(); ++s) {
    if (options.check_rotation)
      drop_odd_rotations(first.features->angle_rad, seconds[s].features->angle_rad, pairs[s]);
    matches[s].assign(first.features->size(), kNoMatch);
    for (const MatchedPair& p : pairs[s]) matches[s][p.first] = p.second;
  }
  return true;
}

}  // namespace

std::vector<std::vector<std::int32_t>> match_descriptors(const Executor& executor,
                                                         const MatchSide& first,
                                                         std::span<const MatchSide> seconds,
                                                         const DescriptorMatchOptions& options) {
  std::vector<std::vector<std::int32_t>> matches(seconds.size());
  if (match_on_device(executor, first, seconds, options, matches)) return matches;
  executor.for_ranges(seconds.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin) {
      matches[begin] = match_on_host(executor, first, seconds[begin], options);
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
