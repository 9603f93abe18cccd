#pragma once

#include <cstdint>
#include <span>

#include "fastloop/features/feature_set.hpp"

namespace fastloop {

/// Batch Hamming distances between 256-bit descriptors.
///
/// The build targets the baseline of the architecture, so that one binary runs everywhere; these
/// functions look at the CPU once and use its population count instruction where there is one. Call
/// them with many candidates at a time: the indirect call is paid once per batch. Reentrant.

/// Distances from `query` to `candidates[indices[k]]`.
/// @param[out] out  [indices.size()]
void hamming_distances(const Descriptor& query, const Descriptor* candidates,
                       std::span<const std::uint16_t> indices, std::uint16_t* out);

/// Distances from `query` to every candidate.
/// @param[out] out  [candidates.size()]
void hamming_distances(const Descriptor& query, std::span<const Descriptor> candidates,
                       std::uint16_t* out);

/// Result of a nearest-descriptor search. Distances are kNoDistance where there is no such
/// candidate.
struct NearestDescriptor {
  static constexpr int kNoDistance = 257;
  std::int32_t position = -1;  ///< in `indices` (or `candidates`); ties take the lower; -1: none
  int distance = kNoDistance;
  int second_distance = kNoDistance;  ///< smallest among the others, >= distance
};

/// The candidate nearest to `query` among `candidates[indices[k]]`.
NearestDescriptor nearest_descriptor(const Descriptor& query, const Descriptor* candidates,
                                     std::span<const std::uint16_t> indices);

/// The candidate nearest to `query` among all of `candidates`.
NearestDescriptor nearest_descriptor(const Descriptor& query,
                                     std::span<const Descriptor> candidates);

/// Candidates [begin, end) of a list.
struct DescriptorRun {
  std::uint32_t begin = 0, end = 0;
};

/// For every query the nearest candidate of its own run (ties: the lower index), as an index into
/// `candidates`; unchanged where the run is empty. Several queries at a time hide the time that
/// candidates take to come from memory.
/// @param[in,out] nearest  [queries.size()]
void nearest_in_runs(std::span<const Descriptor> queries, const Descriptor* candidates,
                     std::span<const DescriptorRun> runs, std::uint32_t* nearest);

/// The portable forms: what the functions above must equal bit for bit.
namespace reference {
void nearest_in_runs(std::span<const Descriptor> queries, const Descriptor* candidates,
                     std::span<const DescriptorRun> runs, std::uint32_t* nearest);
void hamming_distances(const Descriptor& query, const Descriptor* candidates,
                       std::span<const std::uint16_t> indices, std::uint16_t* out);
NearestDescriptor nearest_descriptor(const Descriptor& query, const Descriptor* candidates,
                                     std::span<const std::uint16_t> indices);
}  // namespace reference

}  // namespace fastloop
