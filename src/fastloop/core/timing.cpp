#include "fastloop/core/timing.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

namespace fastloop {

StageStatistics summarize(std::vector<double> samples_ms) {
  StageStatistics s;
  s.count = samples_ms.size();
  if (samples_ms.empty()) return s;
  std::sort(samples_ms.begin(), samples_ms.end());
  const auto rank = [&](double p) {
    const auto n = static_cast<double>(samples_ms.size());
    const auto index = static_cast<std::size_t>(std::max(1.0, std::ceil(p * n))) - 1;
    return samples_ms[std::min(index, samples_ms.size() - 1)];
  };
  s.mean_ms = std::accumulate(samples_ms.begin(), samples_ms.end(), 0.0) /
              static_cast<double>(samples_ms.size());
  s.p50_ms = rank(0.50);
  s.p95_ms = rank(0.95);
  s.p99_ms = rank(0.99);
  s.max_ms = samples_ms.back();
  return s;
}

void StageTimes::add(const std::string& stage, double ms) {
  const std::lock_guard lock(mutex_);
  samples_[stage].push_back(ms);
}

std::map<std::string, StageStatistics> StageTimes::statistics() const {
  const std::lock_guard lock(mutex_);
  std::map<std::string, StageStatistics> result;
  for (const auto& [stage, samples] : samples_) result[stage] = summarize(samples);
  return result;
}

std::vector<double> StageTimes::samples(const std::string& stage) const {
  const std::lock_guard lock(mutex_);
  const auto it = samples_.find(stage);
  return it == samples_.end() ? std::vector<double>{} : it->second;
}

}  // namespace fastloop
