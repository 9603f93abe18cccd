#include "fastloop/matching/rotation_histogram.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "fastloop/matching/projection_search.hpp"

namespace fastloop::matching {

int RotationHistogram::bin(float change_rad) {
  constexpr float kTurn = static_cast<float>(2 * M_PI);
  const float turns = change_rad / kTurn;
  const float fraction = turns - std::floor(turns);
  return std::min(static_cast<int>(fraction * kBins), kBins - 1);
}

std::array<bool, RotationHistogram::kBins> RotationHistogram::kept() const {
  std::array<int, kBins> order;
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [this](int a, int b) { return count_[a] > count_[b]; });
  std::array<bool, kBins> result{};
  for (int i = 0; i < kKept; ++i) result[order[i]] = count_[order[i]] > 0;
  return result;
}

void drop_odd_rotations(std::span<const float> first_angle_rad,
                        std::span<const float> second_angle_rad, std::span<std::int32_t> matches) {
  std::vector<int> bins(matches.size(), -1);
  RotationHistogram histogram;
  for (std::size_t i = 0; i < matches.size(); ++i) {
    if (matches[i] < 0) continue;
    const float change = first_angle_rad[i] - second_angle_rad[matches[i]];
    if (!std::isfinite(change)) continue;
    bins[i] = RotationHistogram::bin(change);
    histogram.add(bins[i]);
  }
  const auto kept = histogram.kept();
  for (std::size_t i = 0; i < matches.size(); ++i)
    if (bins[i] >= 0 && !kept[bins[i]]) matches[i] = kNoMatch;
}

}  // namespace fastloop::matching
