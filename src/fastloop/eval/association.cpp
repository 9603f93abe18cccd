#include "fastloop/eval/association.hpp"

#include <algorithm>

namespace fastloop::eval {
namespace {

using Poses = std::span<const io::StampedPose>;

/// Index of the pose nearest in time; the earlier of two equally near.
std::size_t nearest(Poses poses, Nanoseconds stamp_ns) {
  const auto later = std::lower_bound(
      poses.begin(), poses.end(), stamp_ns,
      [](const io::StampedPose& pose, Nanoseconds stamp) { return pose.stamp_ns < stamp; });
  if (later == poses.begin()) return 0;
  const auto index = static_cast<std::size_t>(later - poses.begin());
  if (later == poses.end()) return index - 1;
  const Nanoseconds to_later = later->stamp_ns - stamp_ns;
  const Nanoseconds to_earlier = stamp_ns - poses[index - 1].stamp_ns;
  return to_earlier <= to_later ? index - 1 : index;
}

Nanoseconds distance_in_time(Nanoseconds a, Nanoseconds b) {
  return a < b ? b - a : a - b;
}

Nanoseconds median_step(Poses poses) {
  std::vector<Nanoseconds> steps;
  for (std::size_t i = 1; i < poses.size(); ++i)
    steps.push_back(poses[i].stamp_ns - poses[i - 1].stamp_ns);
  if (steps.empty()) return 0;
  const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
  std::nth_element(steps.begin(), middle, steps.end());
  return *middle;
}

}  // namespace

std::vector<Match> associate(Poses reference, Poses estimate, Nanoseconds max_difference_ns) {
  const bool estimate_is_longer = estimate.size() > reference.size();
  const Poses fewer = estimate_is_longer ? reference : estimate;
  const Poses more = estimate_is_longer ? estimate : reference;
  std::vector<Match> matches;
  if (more.empty()) return matches;
  for (std::size_t i = 0; i < fewer.size(); ++i) {
    const std::size_t j = nearest(more, fewer[i].stamp_ns);
    if (distance_in_time(fewer[i].stamp_ns, more[j].stamp_ns) > max_difference_ns) continue;
    matches.push_back(estimate_is_longer ? Match{i, j} : Match{j, i});
  }
  return matches;
}

double time_coverage(Poses reference, Poses estimate) {
  if (reference.empty() || estimate.empty()) return 0;
  const Nanoseconds reach_ns = std::max(kMaxTimeDifferenceNs, median_step(estimate));
  const auto covered = std::count_if(reference.begin(), reference.end(), [&](const auto& pose) {
    const Nanoseconds near_ns = estimate[nearest(estimate, pose.stamp_ns)].stamp_ns;
    return distance_in_time(pose.stamp_ns, near_ns) <= reach_ns;
  });
  return static_cast<double>(covered) / static_cast<double>(reference.size());
}

}  // namespace fastloop::eval
