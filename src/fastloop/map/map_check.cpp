#include <algorithm>
#include <unordered_map>

#include "fastloop/map/map.hpp"

namespace fastloop::map {
namespace {

/// Landmarks shared by every pair of keyframes, counted anew from the observations; zeros are left
/// out.
using SharedCounts = std::vector<std::unordered_map<std::uint32_t, int>>;
using Fault = std::optional<std::string>;

std::string name(auto id) {
  return std::to_string(id.value());
}

Fault check_landmark(const Map& map, LandmarkId id, SharedCounts& shared) {
  const Landmark& l = map.landmark(id);
  if (l.observations.empty()) return "landmark " + name(id) + " has no observation";
  bool anchor_observes = false;
  KeyframeId before;
  for (const Observation& o : l.observations) {
    if (!map.contains(o.keyframe))
      return "landmark " + name(id) + " is seen by removed keyframe " + name(o.keyframe);
    if (before.valid() && before >= o.keyframe)
      return "observations of landmark " + name(id) + " are not in order";
    before = o.keyframe;
    const auto& entries = map.keyframe(o.keyframe).landmarks;
    if (o.keypoint >= entries.size() || entries[o.keypoint] != id)
      return "keyframe " + name(o.keyframe) + " does not know landmark " + name(id);
    anchor_observes |= o.keyframe == l.anchor;
    for (const Observation& other : l.observations)
      if (o.keyframe != other.keyframe) ++shared[o.keyframe.value()][other.keyframe.value()];
  }
  if (!anchor_observes) return "anchor of landmark " + name(id) + " does not observe it";
  if (!map.p_world(id).allFinite()) return "landmark " + name(id) + " is not finite";
  return std::nullopt;
}

Fault check_links(const Map& map, KeyframeId id) {
  const Keyframe& k = map.keyframe(id);
  const MapInfo& info = map.map_info(k.map);
  const bool first = id == info.first_keyframe, last = id == info.last_keyframe;
  if (!first && (!map.contains(k.parent) || k.parent >= id))
    return "keyframe " + name(id) + " has no live older parent";
  if (first != !k.previous.valid() || last != !k.next.valid())
    return "keyframe " + name(id) + " is not linked in time";
  const auto linked = [&](KeyframeId other) {
    return map.contains(other) && map.keyframe(other).map == k.map;
  };
  if ((!first && (!linked(k.previous) || map.keyframe(k.previous).next != id)) ||
      (!last && (!linked(k.next) || map.keyframe(k.next).previous != id)))
    return "temporal links of " + name(id) + " are broken";
  if (k.imu_from_previous &&
      (first || k.imu_from_previous->begin_ns() != map.keyframe(k.previous).data->stamp_ns ||
       k.imu_from_previous->end_ns() != k.data->stamp_ns))
    return "IMU measurements of keyframe " + name(id) +
           " do not reach from its predecessor to itself";
  return std::nullopt;
}

Fault check_keyframe(const Map& map, KeyframeId id,
                     const std::unordered_map<std::uint32_t, int>& shared) {
  const Keyframe& k = map.keyframe(id);
  for (std::size_t p = 0; p < k.landmarks.size(); ++p) {
    const LandmarkId l = k.landmarks[p];
    if (!l.valid()) continue;
    if (!map.contains(l)) return "keyframe " + name(id) + " sees removed landmark " + name(l);
    const auto& seen = map.landmark(l).observations;
    if (std::none_of(seen.begin(), seen.end(),
                     [&](const Observation& o) { return o.keyframe == id && o.keypoint == p; }))
      return "landmark " + name(l) + " does not know keyframe " + name(id);
  }
  for (const CovisibilityEdge& e : map.covisible(id)) {
    const auto it = shared.find(e.keyframe.value());
    if (it == shared.end() || it->second != e.shared)
      return "covisibility of " + name(id) + " and " + name(e.keyframe) +
             " is not the number of shared landmarks";
  }
  if (shared.size() != map.covisible(id).size())
    return "covisibility list of keyframe " + name(id) + " is incomplete";
  return check_links(map, id);
}

Fault check_removed(const Map& map, KeyframeId id) {
  const Keyframe& k = map.keyframe(id);
  if (!k.landmarks.empty() || !map.covisible(id).empty())
    return "removed keyframe " + name(id) + " still sees landmarks";
  if (!k.anchor_of_removed.valid() || k.anchor_of_removed >= id)
    return "removed keyframe " + name(id) + " has no older anchor";
  return std::nullopt;
}

}  // namespace

std::optional<std::string> Map::find_inconsistency() const {
  SharedCounts shared(keyframes_.size());
  std::size_t live_landmarks = 0, live_keyframes = 0;
  for (std::uint32_t i = 0; i < landmarks_.size(); ++i) {
    if (!contains(LandmarkId(i))) continue;
    ++live_landmarks;
    if (auto fault = check_landmark(*this, LandmarkId(i), shared)) return fault;
  }
  std::vector<std::size_t> keyframes_of_map(maps_.size(), 0);
  for (std::uint32_t i = 0; i < keyframes_.size(); ++i) {
    const bool live = contains(KeyframeId(i));
    live_keyframes += live;
    keyframes_of_map[keyframes_[i].map.value()] += live;
    if (auto fault = live ? check_keyframe(*this, KeyframeId(i), shared[i])
                          : check_removed(*this, KeyframeId(i)))
      return fault;
  }
  if (live_landmarks != num_landmarks_ || live_keyframes != num_keyframes_)
    return "entity counts are wrong";
  for (const MapInfo& info : maps_)
    if (keyframes_of_map[info.id.value()] != info.num_keyframes)
      return "keyframe count of map " + name(info.id) + " is wrong";
  return std::nullopt;
}

}  // namespace fastloop::map
