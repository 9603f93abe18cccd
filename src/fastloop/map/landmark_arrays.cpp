#include "fastloop/map/landmark_arrays.hpp"

#include <algorithm>

namespace fastloop::map {

LandmarkArrays::LandmarkArrays(const Snapshot& snapshot, std::vector<LandmarkId> chosen)
    : ids(std::move(chosen)) {
  const std::size_t n = ids.size();
  p_world.reserve(n);
  normal_world.reserve(n);
  min_distance_m.reserve(n);
  max_distance_m.reserve(n);
  descriptor.reserve(n);
  for (const LandmarkId id : ids) {
    const Landmark& l = snapshot.landmark(id);
    const SE3& T_world_anchor = snapshot.keyframe(l.anchor).state.T_world_body;
    p_world.push_back((T_world_anchor * l.p_anchor).cast<float>());
    normal_world.push_back((T_world_anchor.rotation * l.normal_anchor.cast<double>()).cast<float>());
    min_distance_m.push_back(l.min_distance_m);
    max_distance_m.push_back(l.max_distance_m);
    descriptor.push_back(l.descriptor);
  }
}

std::vector<LandmarkId> landmarks_of(const Snapshot& snapshot,
                                     std::span<const KeyframeId> keyframes) {
  std::vector<LandmarkId> ids;
  for (const KeyframeId k : keyframes)
    for (const LandmarkId id : snapshot.keyframe(k).landmarks)
      if (id.valid()) ids.push_back(id);
  std::sort(ids.begin(), ids.end());
  ids.erase(std::unique(ids.begin(), ids.end()), ids.end());
  return ids;
}

}  // namespace fastloop::map
