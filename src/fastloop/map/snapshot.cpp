#include "fastloop/map/snapshot.hpp"

#include <algorithm>

namespace fastloop::map {

LandmarkId Snapshot::resolve(LandmarkId id) const {
  while (id.valid() && id.value() < landmarks_.size()) {
    const Landmark& l = landmarks_[id.value()];
    if (!l.removed()) return id;
    id = l.replaced_by;
  }
  return LandmarkId{};
}

MapId Snapshot::resolve(MapId id) const {
  while (map_info(id).merged_into.valid()) id = map_info(id).merged_into;
  return id;
}

SE3 Snapshot::T_world_body(KeyframeId id) const {
  const Keyframe& k = keyframe(id);
  return k.removed ? T_world_body(k.anchor_of_removed) * k.T_anchor_body : k.state.T_world_body;
}

PixelObservation Snapshot::pixel(KeyframeId keyframe_id, std::uint32_t keypoint) const {
  const FeatureSet& f = *keyframe(keyframe_id).data->features;
  PixelObservation z;
  z.left = {f.x[keypoint], f.y[keypoint]};
  z.right = {f.right_x[keypoint], f.right_y[keypoint]};
  return z;
}

int Snapshot::num_shared(KeyframeId a, KeyframeId b) const {
  const std::vector<CovisibilityEdge>& edges = covisible(a);
  const auto it =
      std::lower_bound(edges.begin(), edges.end(), b,
                       [](const CovisibilityEdge& e, KeyframeId id) { return e.keyframe < id; });
  return it != edges.end() && it->keyframe == b ? it->shared : 0;
}

std::vector<KeyframeId> Snapshot::best_covisible(KeyframeId id, std::size_t count,
                                                 int min_shared) const {
  std::vector<CovisibilityEdge> edges;
  for (const CovisibilityEdge& e : covisible(id))
    if (e.shared >= min_shared) edges.push_back(e);
  const auto better = [](const CovisibilityEdge& a, const CovisibilityEdge& b) {
    return a.shared != b.shared ? a.shared > b.shared : a.keyframe < b.keyframe;
  };
  const std::size_t n = std::min(count, edges.size());
  std::partial_sort(edges.begin(), edges.begin() + static_cast<std::ptrdiff_t>(n), edges.end(),
                    better);
  std::vector<KeyframeId> ids;
  for (std::size_t i = 0; i < n; ++i) ids.push_back(edges[i].keyframe);
  return ids;
}

int Snapshot::count_tracked(KeyframeId id, int min_observers) const {
  int count = 0;
  for (const LandmarkId l : keyframe(id).landmarks)
    if (l.valid() && static_cast<int>(landmark(l).observations.size()) >= min_observers) ++count;
  return count;
}

}  // namespace fastloop::map
