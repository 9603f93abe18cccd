#include "fastloop/tracking/local_map.hpp"

#include <algorithm>

namespace fastloop::tracking {

void LocalMap::update(const map::Snapshot& snapshot, const std::vector<LandmarkId>& landmarks,
                      KeyframeId recent, std::size_t max_keyframes) {
  ++mark_;
  keyframe_mark_.resize(snapshot.keyframe_slots(), 0);
  landmark_mark_.resize(snapshot.landmark_slots(), 0);
  choose_keyframes(snapshot, landmarks, recent, max_keyframes);
  gather(snapshot);
}

void LocalMap::choose_keyframes(const map::Snapshot& snapshot,
                                const std::vector<LandmarkId>& landmarks, KeyframeId recent,
                                std::size_t max) {
  keyframes_.clear();
  reference_ = KeyframeId{};
  votes_.assign(snapshot.keyframe_slots(), 0);
  std::vector<KeyframeId> voted;
  for (const LandmarkId matched : landmarks) {
    const LandmarkId id = snapshot.resolve(matched);
    if (!id.valid()) continue;
    for (const map::Observation& o : snapshot.landmark(id).observations)
      if (votes_[o.keyframe.value()]++ == 0) voted.push_back(o.keyframe);
  }
  std::sort(voted.begin(), voted.end(), [&](KeyframeId a, KeyframeId b) {
    const auto va = votes_[a.value()], vb = votes_[b.value()];
    return va != vb ? va > vb : a < b;
  });
  const auto add = [&](KeyframeId id) {
    if (keyframes_.size() >= max || !snapshot.contains(id) || keyframe_mark_[id.value()] == mark_)
      return;
    keyframe_mark_[id.value()] = mark_;
    keyframes_.push_back(id);
  };
  if (!voted.empty()) reference_ = voted.front();
  // Temporal predecessors first: they matter most with an IMU and must survive the cut.
  KeyframeId k = recent;
  for (int i = 0; i < 10 && snapshot.contains(k); ++i) {
    add(k);
    k = snapshot.keyframe(k).previous;
  }
  const std::size_t direct = max - max / 4;
  for (const KeyframeId id : voted)
    if (keyframes_.size() < direct) add(id);
  const std::size_t num_direct = keyframes_.size();
  for (std::size_t i = 0; i < num_direct && keyframes_.size() < max; ++i) {
    for (const KeyframeId neighbour : snapshot.best_covisible(keyframes_[i], 3)) add(neighbour);
    add(snapshot.keyframe(keyframes_[i]).parent);
  }
}

void LocalMap::gather(const map::Snapshot& snapshot) {
  ids_.clear();
  for (const KeyframeId k : keyframes_)
    for (const LandmarkId id : snapshot.keyframe(k).landmarks)
      if (id.valid() && landmark_mark_[id.value()] != mark_) {
        landmark_mark_[id.value()] = mark_;
        ids_.push_back(id);
      }
  std::sort(ids_.begin(), ids_.end());
  const std::size_t n = ids_.size();
  p_world_.resize(n);
  normal_.resize(n);
  min_distance_.resize(n);
  max_distance_.resize(n);
  descriptor_.resize(n);
  for (std::size_t i = 0; i < n; ++i) {
    const map::Landmark& l = snapshot.landmark(ids_[i]);
    const SE3& T_world_anchor = snapshot.keyframe(l.anchor).state.T_world_body;
    p_world_[i] = (T_world_anchor * l.p_anchor).cast<float>();
    normal_[i] = T_world_anchor.rotation.cast<float>() * l.normal_anchor;
    min_distance_[i] = l.min_distance_m;
    max_distance_[i] = l.max_distance_m;
    descriptor_[i] = l.descriptor;
  }
}

matching::LandmarkView LocalMap::view() const {
  return {p_world_, normal_, min_distance_, max_distance_, descriptor_};
}

}  // namespace fastloop::tracking
