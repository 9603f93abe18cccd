#include "fastloop/matching/rotation_histogram.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

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

}  // namespace fastloop::matching
