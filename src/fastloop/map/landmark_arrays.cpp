#include "fastloop/map/landmark_arrays.hpp"

#include <algorithm>
#include <bit>

namespace fastloop::map {

LandmarkArrays::LandmarkArrays(const Snapshot& snapshot, std::vector<LandmarkId> chosen,
                               const Executor& executor)
    : ids(std::move(chosen)) {
  const std::size_t n = ids.size();
  p_world.resize(n);
  normal_world.resize(n);
  min_distance_m.resize(n);
  max_distance_m.resize(n);
  descriptor.resize(n);
  executor.for_ranges(n, 512, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const Landmark& l = snapshot.landmark(ids[i]);
      const SE3& T_world_anchor = snapshot.keyframe(l.anchor).state.T_world_body;
      p_world[i] = (T_world_anchor * l.p_anchor).cast<float>();
      normal_world[i] = (T_world_anchor.rotation * l.normal_anchor.cast<double>()).cast<float>();
      min_distance_m[i] = l.min_distance_m;
      max_distance_m[i] = l.max_distance_m;
      descriptor[i] = l.descriptor;
    }
  });
}

std::vector<LandmarkId> landmarks_of(const Snapshot& snapshot,
                                     std::span<const KeyframeId> keyframes) {
  std::vector<LandmarkId> ids;
  for (const KeyframeId k : keyframes)
    for (const LandmarkId id : snapshot.keyframe(k).landmarks)
      if (id.valid()) ids.push_back(id);
  if (ids.empty()) return ids;
  // Neighbouring keyframes see landmarks with neighbouring ids: marks in a bit field are in order
  // without sorting, unless the ids lie far apart.
  const auto [low, high] = std::minmax_element(ids.begin(), ids.end());
  const std::uint32_t first = low->value();
  const std::size_t range = high->value() - first + 1u;
  if (range / 64 > 4 * ids.size()) {
    std::sort(ids.begin(), ids.end());
    ids.erase(std::unique(ids.begin(), ids.end()), ids.end());
    return ids;
  }
  std::vector<std::uint64_t> seen((range + 63) / 64, 0);
  for (const LandmarkId id : ids) {
    const std::uint32_t bit = id.value() - first;
    seen[bit / 64] |= std::uint64_t{1} << bit % 64;
  }
  ids.clear();
  for (std::size_t word = 0; word < seen.size(); ++word)
    for (std::uint64_t left = seen[word]; left != 0; left &= left - 1)
      ids.push_back(LandmarkId(first + static_cast<std::uint32_t>(64 * word) +
                               static_cast<std::uint32_t>(std::countr_zero(left))));
  return ids;
}

}  // namespace fastloop::map
