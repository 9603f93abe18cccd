#include "fastloop/eval/metrics.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "fastloop/core/error.hpp"

namespace fastloop::eval {

Statistics summarize_errors(std::vector<double> errors) {
  Statistics s;
  s.count = errors.size();
  if (errors.empty()) return s;
  const double count = static_cast<double>(errors.size());
  std::sort(errors.begin(), errors.end());
  double sum = 0, sum_of_squares = 0;
  for (const double e : errors) {
    sum += e;
    sum_of_squares += e * e;
  }
  s.mean = sum / count;
  s.rmse = std::sqrt(sum_of_squares / count);
  double squared_deviation = 0;
  for (const double e : errors) squared_deviation += (e - s.mean) * (e - s.mean);
  s.std = std::sqrt(squared_deviation / count);
  const std::size_t half = errors.size() / 2;
  s.median = errors.size() % 2 ? errors[half] : 0.5 * (errors[half - 1] + errors[half]);
  s.min = errors.front();
  s.max = errors.back();
  return s;
}

std::vector<double> position_errors(std::span<const SE3> reference, std::span<const SE3> estimate) {
  if (reference.size() != estimate.size())
    throw InvalidArgument("position_errors: unequal numbers of poses");
  std::vector<double> errors(reference.size());
  for (std::size_t i = 0; i < errors.size(); ++i)
    errors[i] = (estimate[i].translation - reference[i].translation).norm();
  return errors;
}

std::vector<IndexPair> pairs_in_time(std::span<const Nanoseconds> stamps_ns, Nanoseconds delta_ns,
                                     RpePairs which) {
  if (delta_ns <= 0) throw InvalidArgument("the time of a relative pose error must be positive");
  std::vector<IndexPair> pairs;
  if (stamps_ns.size() < 2) return pairs;
  std::vector<Nanoseconds> steps(stamps_ns.size() - 1);
  for (std::size_t i = 0; i < steps.size(); ++i) steps[i] = stamps_ns[i + 1] - stamps_ns[i];
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  const Nanoseconds tolerance_ns = *middle / 2;

  std::size_t j = 0;
  for (std::size_t i = 0; i + 1 < stamps_ns.size();) {
    const auto miss = [&](std::size_t k) {
      return std::abs(stamps_ns[k] - stamps_ns[i] - delta_ns);
    };
    j = std::max(j, i + 1);
    while (j + 1 < stamps_ns.size() && miss(j + 1) < miss(j)) ++j;
    const bool accepted = miss(j) <= tolerance_ns;
    if (accepted) pairs.push_back({i, j});
    i = accepted && which == RpePairs::kConsecutive ? j : i + 1;
  }
  return pairs;
}

RelativeErrors relative_errors(std::span<const SE3> reference, std::span<const SE3> estimate,
                               std::span<const IndexPair> pairs) {
  if (reference.size() != estimate.size())
    throw InvalidArgument("relative_errors: unequal numbers of poses");
  RelativeErrors errors;
  for (const auto [i, j] : pairs) {
    const SE3 reference_motion = reference[i].inverse() * reference[j];
    const SE3 estimated_motion = estimate[i].inverse() * estimate[j];
    const SE3 error = reference_motion.inverse() * estimated_motion;
    errors.translation_m.push_back(error.translation.norm());
    errors.rotation_deg.push_back(so3::log(error.rotation).norm() * 180 / std::numbers::pi);
  }
  return errors;
}

double path_length(std::span<const SE3> poses) {
  double length_m = 0;
  for (std::size_t i = 1; i < poses.size(); ++i)
    length_m += (poses[i].translation - poses[i - 1].translation).norm();
  return length_m;
}

}  // namespace fastloop::eval
