#include "fastloop/io/frame_pairing.hpp"

#include <algorithm>
#include <cstdlib>

namespace fastloop::io {
namespace {

/// Index of the nearest stamp in a non-empty increasing list; of two equally near ones the earlier.
std::size_t nearest(std::span<const Nanoseconds> stamps, Nanoseconds t) {
  const auto after = std::lower_bound(stamps.begin(), stamps.end(), t);
  if (after == stamps.begin()) return 0;
  const auto index = static_cast<std::size_t>(after - stamps.begin());
  if (after == stamps.end() || t - stamps[index - 1] <= *after - t) return index - 1;
  return index;
}

}  // namespace

std::vector<IndexPair> pair_by_time(std::span<const Nanoseconds> left,
                                    std::span<const Nanoseconds> right, Nanoseconds tolerance_ns) {
  std::vector<IndexPair> pairs;
  if (left.empty() || right.empty()) return pairs;
  for (std::size_t i = 0; i < left.size(); ++i) {
    const std::size_t j = nearest(right, left[i]);
    if (std::abs(left[i] - right[j]) <= tolerance_ns && nearest(left, right[j]) == i)
      pairs.push_back({i, j});
  }
  return pairs;
}

Nanoseconds median_gap_ns(std::span<const Nanoseconds> stamps) {
  if (stamps.size() < 2) return 0;
  std::vector<Nanoseconds> gaps;
  for (std::size_t i = 1; i < stamps.size(); ++i) gaps.push_back(stamps[i] - stamps[i - 1]);
  const auto middle = gaps.begin() + static_cast<std::ptrdiff_t>(gaps.size() / 2);
  std::nth_element(gaps.begin(), middle, gaps.end());
  return *middle;
}

Nanoseconds pairing_tolerance_ns(std::span<const Nanoseconds> left,
                                 std::span<const Nanoseconds> right, Nanoseconds limit_ns) {
  Nanoseconds tolerance = limit_ns;
  for (const Nanoseconds gap : {median_gap_ns(left), median_gap_ns(right)})
    if (gap > 0) tolerance = std::min(tolerance, gap / 2);
  return tolerance;
}

}  // namespace fastloop::io
