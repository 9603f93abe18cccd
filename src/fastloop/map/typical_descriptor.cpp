#include "fastloop/map/typical_descriptor.hpp"

#include <algorithm>
#include <array>
#include <vector>

#include "fastloop/core/error.hpp"
#include "fastloop/features/hamming.hpp"

namespace fastloop::map {

std::size_t typical_descriptor(std::span<const Descriptor> descriptors) {
  const std::size_t n = descriptors.size();
  if (n > kMaxVoters) throw InvalidArgument("typical_descriptor: too many descriptors");
  std::array<std::array<std::uint16_t, kMaxVoters>, kMaxVoters> distance;
  for (std::size_t i = 0; i < n; ++i) {
    distance[i][i] = 0;
    hamming_distances(descriptors[i], descriptors.subspan(i + 1), distance[i].data() + i + 1);
    for (std::size_t j = i + 1; j < n; ++j) distance[j][i] = distance[i][j];
  }
  const std::size_t middle = n == 0 ? 0 : (n - 1) / 2;
  std::size_t best = 0;
  std::uint16_t best_median = 257;
  for (std::size_t i = 0; i < n; ++i) {
    // Counting tells whether this row's median is smaller; only then is it worth finding.
    std::size_t smaller = 0;
    for (std::size_t j = 0; j < n; ++j) smaller += distance[i][j] < best_median;
    if (smaller <= middle) continue;
    const auto row = distance[i].begin();
    std::nth_element(row, row + static_cast<std::ptrdiff_t>(middle),
                     row + static_cast<std::ptrdiff_t>(n));
    best_median = distance[i][middle];
    best = i;
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
