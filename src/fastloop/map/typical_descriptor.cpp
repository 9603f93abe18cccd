#include "fastloop/map/typical_descriptor.hpp"

#include <algorithm>
#include <array>
#include <vector>

#include "fastloop/core/error.hpp"
#include "fastloop/features/hamming.hpp"

namespace fastloop::map {

namespace {

using Row = std::array<std::uint16_t, kMaxVoters>;

/// The loop has a fixed length, so that the compiler makes a few vector instructions of it.
int count_at_most(const Row& row, std::uint16_t limit) {
  std::uint16_t count = 0;
  for (const std::uint16_t d : row) count += static_cast<std::uint16_t>(d <= limit);
  return count;
}

}  // namespace

std::size_t typical_descriptor(std::span<const Descriptor> descriptors) {
  const std::size_t n = descriptors.size();
  if (n > kMaxVoters) throw InvalidArgument("typical_descriptor: too many descriptors");
  if (n == 0) return 0;
  std::array<Row, kMaxVoters> distance;
  for (std::size_t i = 0; i < n; ++i) {
    distance[i].fill(0xffff);
    for (std::size_t j = 0; j < i; ++j) distance[i][j] = distance[j][i];
    distance[i][i] = 0;
    hamming_distances(descriptors[i], descriptors.subspan(i + 1), distance[i].data() + i + 1);
  }
  const int middle = static_cast<int>((n - 1) / 2);
  std::size_t best = 0;
  std::uint16_t best_median = 257;
  for (std::size_t i = 0; i < n; ++i) {
    const auto beyond = [&](std::uint16_t d) { return count_at_most(distance[i], d) > middle; };
    if (!beyond(static_cast<std::uint16_t>(best_median - 1))) continue;
    // The median is the smallest distance with more than `middle` entries up to it.
    std::uint16_t low = 0, high = static_cast<std::uint16_t>(best_median - 1);
    while (low < high) {
      const auto half = static_cast<std::uint16_t>((low + high) / 2);
      beyond(half) ? high = half : low = static_cast<std::uint16_t>(half + 1);
    }
    best_median = low;
    best = i;
    if (best_median == 0) break;  // it cannot get smaller
  }
  return best;
}

namespace reference {

std::size_t typical_descriptor(std::span<const Descriptor> descriptors) {
  std::size_t best = 0;
  int best_median = 257;
  std::vector<int> distances(descriptors.size());
  for (std::size_t i = 0; i < descriptors.size(); ++i) {
    for (std::size_t j = 0; j < descriptors.size(); ++j)
      distances[j] = hamming_distance(descriptors[i], descriptors[j]);
    const auto middle = distances.begin() + static_cast<std::ptrdiff_t>((distances.size() - 1) / 2);
    std::nth_element(distances.begin(), middle, distances.end());
    if (*middle < best_median) {
      best_median = *middle;
      best = i;
    }
  }
  return best;
}

}  // namespace reference
}  // namespace fastloop::map
