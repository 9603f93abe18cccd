#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "fastloop/compute/host_device.hpp"
#include "fastloop/matching/bag_of_words.hpp"

namespace fastloop::matching {

/// FeatureGroups as raw pointers.
struct GroupView {
  const std::uint32_t* node;
  const std::uint32_t* start;
  const std::uint16_t* indices;
  int size;
};

/// Groups as one block that can be copied anywhere.
inline std::size_t packed_bytes(const FeatureGroups& g) {
  return (2 * g.node.size() + 1) * sizeof(std::uint32_t) + g.indices.size() * sizeof(std::uint16_t);
}

/// The arrays of such groups in a block, wherever it lies.
inline GroupView packed_groups(const std::byte* block, const FeatureGroups& g) {
  const std::size_t n = g.node.size();
  const auto* words = reinterpret_cast<const std::uint32_t*>(block);
  return {words, words + n, reinterpret_cast<const std::uint16_t*>(words + 2 * n + 1),
          static_cast<int>(n)};
}

/// @param out  [packed_bytes(g)] aligned to 4
inline void pack_groups(const FeatureGroups& g, std::byte* out) {
  auto* next = reinterpret_cast<std::uint32_t*>(out);
  next = std::copy(g.node.begin(), g.node.end(), next);
  if (g.start.empty())
    *next++ = 0;  // no groups at all
  else
    next = std::copy(g.start.begin(), g.start.end(), next);
  std::copy(g.indices.begin(), g.indices.end(), reinterpret_cast<std::uint16_t*>(next));
}

}  // namespace fastloop::matching
