#include "fastloop/map/map.hpp"

#include <algorithm>
#include <array>

#include "fastloop/core/error.hpp"
#include "fastloop/map/typical_descriptor.hpp"

namespace fastloop::map {
namespace {

auto lower_bound_keyframe(auto& list, KeyframeId id) {
  return std::lower_bound(list.begin(), list.end(), id,
                          [](const auto& entry, KeyframeId key) { return entry.keyframe < key; });
}

}  // namespace

Map::Map(const StereoRig& rig, const PyramidScales& scales) {
  rig_ = rig;
  scales_ = scales;
}

MapId Map::start_map() {
  MapInfo info;
  info.id = MapId(static_cast<std::uint32_t>(maps_.size()));
  maps_.push_back(info);
  ++version_;
  return info.id;
}

KeyframeId Map::add_keyframe(MapId map_id, std::shared_ptr<const KeyframeData> data,
                             const NavState& state,
                             std::shared_ptr<const PreintegratedImu> imu_from_previous) {
  const KeyframeId id(static_cast<std::uint32_t>(keyframes_.size()));
  MapInfo& info = maps_.at(map_id.value());
  Keyframe k;
  k.landmarks = KeypointLandmarks(std::vector<LandmarkId>(data->features->size()));
  k.data = std::move(data);
  k.map = map_id;
  k.state = state;
  k.previous = info.last_keyframe;
  k.imu_from_previous = std::move(imu_from_previous);
  keyframes_.push_back(std::move(k));
  covisibility_.push_back({});
  if (info.last_keyframe.valid()) keyframes_.mutate(info.last_keyframe.value()).next = id;
  if (!info.first_keyframe.valid()) info.first_keyframe = id;
  info.last_keyframe = id;
  ++info.num_keyframes;
  ++num_keyframes_;
  ++version_;
  return id;
}

void Map::remove_keyframe(KeyframeId id) {
  if (!contains(id)) throw InvalidArgument("there is no live keyframe of this id to remove");
  const MapInfo& info = map_info(keyframe(id).map);
  if (id == info.first_keyframe || id == info.last_keyframe)
    throw InvalidArgument("the first and the last keyframe of a map cannot be removed");
  const std::vector<LandmarkId> seen = keyframe(id).landmarks;
  for (const LandmarkId l : seen)
    if (l.valid()) remove_observation(l, id);
  relink_children(id);

  Keyframe& k = keyframes_.mutate(id.value());
  Keyframe& previous = keyframes_.mutate(k.previous.value());
  previous.next = k.next;
  Keyframe& next = keyframes_.mutate(k.next.value());
  next.previous = k.previous;
  if (k.imu_from_previous && next.imu_from_previous)
    next.imu_from_previous = std::make_shared<PreintegratedImu>(
        k.imu_from_previous->joined(*next.imu_from_previous).rebased(previous.state.bias));
  else
    next.imu_from_previous = nullptr;

  k.anchor_of_removed = k.parent.valid() ? k.parent : k.previous;
  k.T_anchor_body = T_world_body(k.anchor_of_removed).inverse() * k.state.T_world_body;
  k.removed = true;
  k.landmarks = {};
  // The features of a removed keyframe are never read again: only its stamp and frame are kept.
  auto bare = std::make_shared<KeyframeData>(*k.data);
  bare->features = nullptr;
  k.data = std::move(bare);
  k.imu_from_previous = nullptr;
  --maps_[k.map.value()].num_keyframes;
  --num_keyframes_;
  ++version_;
}

void Map::relink_children(KeyframeId removed) {
  const KeyframeId grandparent = keyframe(removed).parent;
  const MapId map = keyframe(removed).map;
  for (std::size_t i = 0; i < keyframes_.size(); ++i) {
    if (keyframes_[i].removed || keyframes_[i].parent != removed || keyframes_[i].map != map)
      continue;
    // The best live covisible keyframe older than the child keeps the tree free of cycles.
    KeyframeId best = grandparent;
    int best_shared = 0;
    for (const CovisibilityEdge& e : covisibility_[i])
      if (e.keyframe.value() < i && e.keyframe != removed && keyframe(e.keyframe).map == map &&
          e.shared > best_shared) {
        best = e.keyframe;
        best_shared = e.shared;
      }
    keyframes_.mutate(i).parent = best;
  }
}

LandmarkId Map::add_landmark(KeyframeId keyframe_id, std::uint32_t keypoint,
                             const Vector3d& p_world) {
  const LandmarkId id(static_cast<std::uint32_t>(landmarks_.size()));
  Landmark l;
  l.anchor = keyframe_id;
  l.first_keyframe = keyframe_id;
  l.p_anchor = keyframe(keyframe_id).state.T_world_body.inverse() * p_world;
  landmarks_.push_back(std::move(l));
  ++num_landmarks_;
  ++version_;
  add_observation(id, keyframe_id, keypoint);
  refresh_landmark(id);
  return id;
}

void Map::remove_landmark(LandmarkId id) {
  if (!contains(id)) return;
  const std::vector<Observation> observations = landmark(id).observations;
  for (const Observation& o : observations) {
    keyframes_.mutate(o.keyframe.value()).landmarks.set(o.keypoint, LandmarkId{});
    for (const Observation& other : observations)
      if (other.keyframe < o.keyframe) change_shared(o.keyframe, other.keyframe, -1);
  }
  Landmark& l = landmarks_.mutate(id.value());
  l.anchor = KeyframeId{};
  l.observations.clear();
  l.observations.shrink_to_fit();
  --num_landmarks_;
  ++version_;
}

bool Map::add_observation(LandmarkId id, KeyframeId keyframe_id, std::uint32_t keypoint) {
  if (!contains(id) || !contains(keyframe_id) || keyframe(keyframe_id).landmarks[keypoint].valid())
    return false;
  const auto& present = landmark(id).observations;
  const auto at = lower_bound_keyframe(present, keyframe_id);
  if (at != present.end() && at->keyframe == keyframe_id) return false;
  for (const Observation& o : present) change_shared(keyframe_id, o.keyframe, +1);
  auto& observations = landmarks_.mutate(id.value()).observations;
  observations.insert(lower_bound_keyframe(observations, keyframe_id),
                      Observation{keyframe_id, keypoint});
  keyframes_.mutate(keyframe_id.value()).landmarks.set(keypoint, id);
  ++version_;
  return true;
}

void Map::remove_observation(LandmarkId id, KeyframeId keyframe_id, int min_observers) {
  const auto& present = landmark(id).observations;
  const auto at = lower_bound_keyframe(present, keyframe_id);
  if (at == present.end() || at->keyframe != keyframe_id) return;
  if (static_cast<int>(present.size()) - 1 < std::max(1, min_observers)) {
    remove_landmark(id);
    return;
  }
  const Vector3d p = p_world(id);
  Landmark& l = landmarks_.mutate(id.value());
  const auto it = lower_bound_keyframe(l.observations, keyframe_id);
  keyframes_.mutate(keyframe_id.value()).landmarks.set(it->keypoint, LandmarkId{});
  l.observations.erase(it);
  for (const Observation& o : l.observations) change_shared(keyframe_id, o.keyframe, -1);
  if (l.anchor == keyframe_id) {
    const Vector3d normal =
        keyframe(keyframe_id).state.T_world_body.rotation * l.normal_anchor.cast<double>();
    l.anchor = l.observations.front().keyframe;
    const SE3& T_world_anchor = keyframe(l.anchor).state.T_world_body;
    l.p_anchor = T_world_anchor.inverse() * p;
    l.normal_anchor = (T_world_anchor.rotation.conjugate() * normal).cast<float>();
  }
  ++version_;
}

void Map::replace_landmark(LandmarkId loser, LandmarkId winner, bool published_refresh) {
  if (loser == winner || !contains(loser) || !contains(winner)) return;
  const std::vector<Observation> observations = landmark(loser).observations;
  const std::uint32_t visible = landmark(loser).visible, found = landmark(loser).found;
  remove_landmark(loser);
  landmarks_.mutate(loser.value()).replaced_by = winner;
  for (const Observation& o : observations) add_observation(winner, o.keyframe, o.keypoint);
  count_visible(winner, visible, found);
  set_appearance(winner, appearance_of(winner, published_refresh));
}

void Map::set_state(KeyframeId id, const NavState& state) {
  keyframes_.mutate(id.value()).state = state;
  ++version_;
  ++pose_version_;
}

void Map::set_states(const Executor& executor,
                     std::span<const std::pair<KeyframeId, NavState>> states) {
  // A chunk of keyframes is one thread's alone, for it may have to be cloned.
  constexpr std::size_t kChunk = Keyframes::kItems;
  const std::size_t chunks = (keyframes_.size() + kChunk - 1) / kChunk;
  executor.for_ranges(chunks, 16, [&](std::size_t begin, std::size_t end) {
    auto it = std::lower_bound(
        states.begin(), states.end(), begin * kChunk,
        [](const auto& entry, std::size_t first) { return entry.first.value() < first; });
    for (; it != states.end() && it->first.value() < end * kChunk; ++it)
      keyframes_.mutate(it->first.value()).state = it->second;
  });
  ++version_;
  ++pose_version_;
}

void Map::set_p_world(LandmarkId id, const Vector3d& p) {
  const SE3 T_body_world = keyframe(landmark(id).anchor).state.T_world_body.inverse();
  landmarks_.mutate(id.value()).p_anchor = T_body_world * p;
  ++version_;
}

void Map::transform_map(MapId map, const SE3& T_new_old) {
  for (std::size_t i = 0; i < keyframes_.size(); ++i) {
    if (keyframes_[i].map != map || keyframes_[i].removed) continue;
    NavState& s = keyframes_.mutate(i).state;
    s.T_world_body = T_new_old * s.T_world_body;
    s.v_world = T_new_old.rotation * s.v_world;
  }
  note_frame_change();
}

void Map::merge_maps(MapId from, MapId into, KeyframeId link) {
  if (from == into) throw InvalidArgument("a map cannot be merged into itself");
  MapInfo& gone = maps_.at(from.value());
  MapInfo& kept = maps_.at(into.value());
  const KeyframeId root = std::max(gone.first_keyframe, kept.first_keyframe);
  KeyframeId before;
  for (std::uint32_t i = 0; i < keyframes_.size(); ++i) {
    if (keyframes_[i].map != from && keyframes_[i].map != into) continue;
    Keyframe& k = keyframes_.mutate(i);
    k.map = into;
    if (k.removed) continue;
    const KeyframeId id(i);
    if (k.previous != before) {
      k.previous = before;
      k.imu_from_previous = nullptr;
    }
    k.next = KeyframeId{};
    if (before.valid())
      keyframes_.mutate(before.value()).next = id;
    else
      kept.first_keyframe = id;
    before = id;
  }
  kept.last_keyframe = before;
  kept.num_keyframes += gone.num_keyframes;
  gone.num_keyframes = 0;
  gone.first_keyframe = gone.last_keyframe = KeyframeId{};
  gone.merged_into = into;
  if (root.valid()) {  // invalid when one of them was empty
    Keyframe& k = keyframes_.mutate(root.value());
    k.parent = contains(link) && link < root ? link : k.previous;
  }
  note_frame_change();
}

void Map::add_loop_edge(const LoopEdge& edge) {
  loop_edges_.push_back(edge);
  ++version_;
}

void Map::note_frame_change() {
  ++version_;
  ++pose_version_;
  ++frame_version_;
}

void Map::set_p_anchor(LandmarkId id, const Vector3d& p_anchor) {
  landmarks_.mutate(id.value()).p_anchor = p_anchor;
  ++version_;
}

void Map::set_imu(KeyframeId id, std::shared_ptr<const PreintegratedImu> imu) {
  keyframes_.mutate(id.value()).imu_from_previous = std::move(imu);
  ++version_;
}

Map::Appearance Map::appearance_of(LandmarkId id, bool published) const {
  const Landmark& now = landmark(id);
  const Vector3d p = p_world(id);
  // Not all observers vote for the descriptor; the newest are the most like what comes next.
  const std::size_t n = now.observations.size();
  const std::size_t voters = std::min(n, kMaxVoters);
  std::array<Descriptor, kMaxVoters> descriptors;
  Vector3d normal_sum = Vector3d::Zero();
  std::uint8_t octave = 0;
  for (std::size_t i = 0; i < n; ++i) {
    const Observation& o = now.observations[i];
    const Keyframe& k = keyframe(o.keyframe);
    normal_sum += (p - k.state.T_world_body * rig_.T_body_left.translation).normalized();
    if (i + voters >= n) descriptors[i + voters - n] = k.data->features->descriptors[o.keypoint];
    if (o.keyframe == now.anchor) octave = k.data->features->octave[o.keypoint];
  }
  const std::span<const Descriptor> votes(descriptors.data(), voters);
  const NavState& anchor = keyframe(now.anchor).state;
  const double distance =
      (p - anchor.T_world_body * rig_.T_body_left.translation).norm();
  Appearance a;
  a.descriptor =
      votes[published ? reference::typical_descriptor(votes) : typical_descriptor(votes)];
  a.normal_anchor =
      (anchor.T_world_body.rotation.conjugate() * normal_sum.normalized()).cast<float>();
  a.max_distance_m = static_cast<float>(distance * scales_.scale[octave]);
  return a;
}

void Map::set_appearance(LandmarkId id, const Appearance& appearance) {
  Landmark& l = landmarks_.mutate(id.value());
  l.descriptor = appearance.descriptor;
  l.normal_anchor = appearance.normal_anchor;
  l.max_distance_m = appearance.max_distance_m;
  l.min_distance_m = l.max_distance_m / scales_.scale.back();
}

void Map::refresh_landmark(LandmarkId id) { set_appearance(id, appearance_of(id, false)); }

void Map::count_visible(LandmarkId id, std::uint32_t visible, std::uint32_t found) {
  Landmark& l = landmarks_.mutate(id.value());
  l.visible += visible;
  l.found += found;
}

void Map::attach_to_spanning_tree(KeyframeId id) {
  if (map_info(keyframe(id).map).first_keyframe == id) return;
  KeyframeId best = keyframe(id).previous;
  int shared = 0;
  for (const CovisibilityEdge& e : covisible(id))
    if (e.keyframe < id && keyframe(e.keyframe).map == keyframe(id).map && e.shared > shared) {
      best = e.keyframe;
      shared = e.shared;
    }
  keyframes_.mutate(id.value()).parent = best;
}

void Map::change_shared(KeyframeId a, KeyframeId b, int change) {
  if (a == b) return;
  const auto apply = [&](KeyframeId from, KeyframeId to) {
    auto& edges = covisibility_.mutate(from.value());
    auto it = lower_bound_keyframe(edges, to);
    if (it == edges.end() || it->keyframe != to) it = edges.insert(it, CovisibilityEdge{to, 0});
    it->shared += change;
    if (it->shared <= 0) edges.erase(it);
  };
  apply(a, b);
  apply(b, a);
}

}  // namespace fastloop::map
