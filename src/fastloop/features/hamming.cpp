#include "fastloop/features/hamming.hpp"

#include <algorithm>

namespace fastloop {
namespace {

/// Candidate k of a batch, by index list or in sequence.
struct Indexed {
  const Descriptor* candidates;
  const std::uint16_t* indices;
  inline const Descriptor& operator()(std::size_t k) const { return candidates[indices[k]]; }
};
struct Sequence {
  const Descriptor* candidates;
  inline const Descriptor& operator()(std::size_t k) const { return candidates[k]; }
};

inline void take(NearestDescriptor& best, int distance, std::size_t k) {
  if (distance < best.distance) {
    best.second_distance = best.distance;
    best.distance = distance;
    best.position = static_cast<std::int32_t>(k);
  } else if (distance < best.second_distance) {
    best.second_distance = distance;
  }
}

template <class Access>
void distances_portable(const Descriptor& query, Access at, std::size_t n, std::uint16_t* out) {
  for (std::size_t k = 0; k < n; ++k)
    out[k] = static_cast<std::uint16_t>(hamming_distance(query, at(k)));
}

template <class Access>
NearestDescriptor nearest_portable(const Descriptor& query, Access at, std::size_t n) {
  NearestDescriptor best;
  for (std::size_t k = 0; k < n; ++k) take(best, hamming_distance(query, at(k)), k);
  return best;
}

void runs_portable(std::span<const Descriptor> queries, const Descriptor* candidates,
                   std::span<const DescriptorRun> runs, std::uint32_t* out) {
  for (std::size_t q = 0; q < queries.size(); ++q) {
    int best = NearestDescriptor::kNoDistance;
    for (std::uint32_t k = runs[q].begin; k < runs[q].end; ++k) {
      const int distance = hamming_distance(queries[q], candidates[k]);
      if (distance < best) {
        best = distance;
        out[q] = k;
      }
    }
  }
}

#if defined(__x86_64__) && defined(__GNUC__)

__attribute__((target("popcnt"), always_inline)) inline int distance_popcnt(const Descriptor& a,
                                                                            const Descriptor& b) {
  return __builtin_popcountll(a.words[0] ^ b.words[0]) +
         __builtin_popcountll(a.words[1] ^ b.words[1]) +
         __builtin_popcountll(a.words[2] ^ b.words[2]) +
         __builtin_popcountll(a.words[3] ^ b.words[3]);
}

template <class Access>
__attribute__((target("popcnt"))) void distances_popcnt(const Descriptor& query, Access at,
                                                        std::size_t n, std::uint16_t* out) {
  for (std::size_t k = 0; k < n; ++k)
    out[k] = static_cast<std::uint16_t>(distance_popcnt(query, at(k)));
}

template <class Access>
__attribute__((target("popcnt"))) NearestDescriptor nearest_popcnt(const Descriptor& query,
                                                                   Access at, std::size_t n) {
  NearestDescriptor best;
  for (std::size_t k = 0; k < n; ++k) take(best, distance_popcnt(query, at(k)), k);
  return best;
}

__attribute__((target("popcnt"))) void runs_popcnt(std::span<const Descriptor> queries,
                                                   const Descriptor* candidates,
                                                   std::span<const DescriptorRun> runs,
                                                   std::uint32_t* out) {
  for (const DescriptorRun& run : runs)
    for (std::uint32_t k = run.begin; k < run.end; k += 2) __builtin_prefetch(candidates + k);
  for (std::size_t q = 0; q < queries.size(); ++q) {
    // (distance, index) in one number: the smallest is the answer, without a branch.
    std::uint64_t best = ~std::uint64_t{0};
    for (std::uint32_t k = runs[q].begin; k < runs[q].end; ++k) {
      const auto distance = static_cast<std::uint64_t>(distance_popcnt(queries[q], candidates[k]));
      best = std::min(best, distance << 32 | k);
    }
    if (runs[q].begin < runs[q].end) out[q] = static_cast<std::uint32_t>(best);
  }
}

bool has_popcnt() {
  static const bool supported = __builtin_cpu_supports("popcnt");
  return supported;
}

template <class Access>
void distances(const Descriptor& query, Access at, std::size_t n, std::uint16_t* out) {
  has_popcnt() ? distances_popcnt(query, at, n, out) : distances_portable(query, at, n, out);
}

template <class Access>
NearestDescriptor nearest(const Descriptor& query, Access at, std::size_t n) {
  return has_popcnt() ? nearest_popcnt(query, at, n) : nearest_portable(query, at, n);
}

void in_runs(std::span<const Descriptor> queries, const Descriptor* candidates,
             std::span<const DescriptorRun> runs, std::uint32_t* out) {
  has_popcnt() ? runs_popcnt(queries, candidates, runs, out)
               : runs_portable(queries, candidates, runs, out);
}

#else

template <class Access>
void distances(const Descriptor& query, Access at, std::size_t n, std::uint16_t* out) {
  distances_portable(query, at, n, out);
}

template <class Access>
NearestDescriptor nearest(const Descriptor& query, Access at, std::size_t n) {
  return nearest_portable(query, at, n);
}

void in_runs(std::span<const Descriptor> queries, const Descriptor* candidates,
             std::span<const DescriptorRun> runs, std::uint32_t* out) {
  runs_portable(queries, candidates, runs, out);
}

#endif

}  // namespace

void hamming_distances(const Descriptor& query, const Descriptor* candidates,
                       std::span<const std::uint16_t> indices, std::uint16_t* out) {
  distances(query, Indexed{candidates, indices.data()}, indices.size(), out);
}

void hamming_distances(const Descriptor& query, std::span<const Descriptor> candidates,
                       std::uint16_t* out) {
  distances(query, Sequence{candidates.data()}, candidates.size(), out);
}

NearestDescriptor nearest_descriptor(const Descriptor& query, const Descriptor* candidates,
                                     std::span<const std::uint16_t> indices) {
  return nearest(query, Indexed{candidates, indices.data()}, indices.size());
}

NearestDescriptor nearest_descriptor(const Descriptor& query,
                                     std::span<const Descriptor> candidates) {
  return nearest(query, Sequence{candidates.data()}, candidates.size());
}

void nearest_in_runs(std::span<const Descriptor> queries, const Descriptor* candidates,
                     std::span<const DescriptorRun> runs, std::uint32_t* nearest) {
  in_runs(queries, candidates, runs, nearest);
}

namespace reference {

void nearest_in_runs(std::span<const Descriptor> queries, const Descriptor* candidates,
                     std::span<const DescriptorRun> runs, std::uint32_t* nearest) {
  runs_portable(queries, candidates, runs, nearest);
}

void hamming_distances(const Descriptor& query, const Descriptor* candidates,
                       std::span<const std::uint16_t> indices, std::uint16_t* out) {
  distances_portable(query, Indexed{candidates, indices.data()}, indices.size(), out);
}

NearestDescriptor nearest_descriptor(const Descriptor& query, const Descriptor* candidates,
                                     std::span<const std::uint16_t> indices) {
  return nearest_portable(query, Indexed{candidates, indices.data()}, indices.size());
}

}  // namespace reference
}  // namespace fastloop
