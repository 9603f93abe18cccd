#include "fastloop/mapping/local_adjustment.hpp"

#include <algorithm>
#include <unordered_map>

#include "fastloop/core/logging.hpp"

namespace fastloop::mapping {
namespace {

bool is_in(const std::vector<KeyframeId>& list, KeyframeId id) {
  return std::find(list.begin(), list.end(), id) != list.end();
}

/// Keyframes outside `free` that see most landmarks of `free`.
std::vector<KeyframeId> best_outside(const map::Map& map, const std::vector<KeyframeId>& free,
                                     std::size_t count) {
  std::vector<int> shared(map.keyframe_slots(), 0);
  for (const KeyframeId k : free)
    for (const map::CovisibilityEdge& e : map.covisible(k)) shared[e.keyframe.value()] += e.shared;
  for (const KeyframeId k : free) shared[k.value()] = 0;
  std::vector<KeyframeId> ids;
  for (std::uint32_t i = 0; i < shared.size(); ++i)
    if (shared[i] > 0) ids.push_back(KeyframeId(i));
  std::sort(ids.begin(), ids.end(), [&](KeyframeId a, KeyframeId b) {
    return shared[a.value()] != shared[b.value()] ? shared[a.value()] > shared[b.value()] : a < b;
  });
  if (ids.size() > count) ids.resize(count);
  return ids;
}

}  // namespace

MapAdjustment::MapAdjustment(const map::Map& map, const std::vector<KeyframeId>& free,
                             const std::vector<KeyframeId>& fixed, bool inertial,
                             std::size_t max_points) {
  problem_.rig = map.rig();
  add_poses(map, free, fixed);
  add_points(map, free.size(), max_points);
  if (inertial) add_imu_edges(map);
}

void MapAdjustment::add_poses(const map::Map& map, const std::vector<KeyframeId>& free,
                              const std::vector<KeyframeId>& fixed) {
  for (const auto* list : {&free, &fixed})
    for (const KeyframeId id : *list) {
      optimization::BundlePose pose;
      pose.state = map.keyframe(id).state;
      pose.pose_fixed = pose.motion_fixed = list == &fixed;
      problem_.poses.push_back(pose);
      keyframes_.push_back(id);
    }
}

void MapAdjustment::add_points(const map::Map& map, std::size_t num_free, std::size_t max_points) {
  std::vector<LandmarkId> ids;
  for (std::size_t i = 0; i < num_free; ++i)
    for (const LandmarkId l : map.keyframe(keyframes_[i]).landmarks)
      if (l.valid()) ids.push_back(l);
  std::sort(ids.begin(), ids.end());
  ids.erase(std::unique(ids.begin(), ids.end()), ids.end());
  if (ids.size() > max_points) {
    std::stable_sort(ids.begin(), ids.end(), [&](LandmarkId a, LandmarkId b) {
      return map.landmark(a).observations.size() > map.landmark(b).observations.size();
    });
    ids.resize(max_points);
    std::sort(ids.begin(), ids.end());
  }
  landmarks_ = std::move(ids);

  std::unordered_map<std::uint32_t, int> pose_of;
  for (std::size_t i = 0; i < keyframes_.size(); ++i)
    pose_of[keyframes_[i].value()] = static_cast<int>(i);
  for (std::size_t p = 0; p < landmarks_.size(); ++p) {
    problem_.points.push_back(map.p_world(landmarks_[p]));
    for (const map::Observation& o : map.landmark(landmarks_[p]).observations) {
      const auto it = pose_of.find(o.keyframe.value());
      if (it == pose_of.end()) continue;
      optimization::BundleObservation z;
      z.pose = it->second;
      z.point = static_cast<int>(p);
      z.pixel = map.pixel(o.keyframe, o.keypoint);
      const FeatureSet& f = *map.keyframe(o.keyframe).data->features;
      z.inv_sigma2 = 1.0 / map.scales().sigma2[f.octave[o.keypoint]];
      problem_.observations.push_back(z);
      seen_.push_back(o);
    }
  }
}

void MapAdjustment::add_imu_edges(const map::Map& map) {
  for (std::size_t to = 0; to < keyframes_.size(); ++to) {
    const map::Keyframe& k = map.keyframe(keyframes_[to]);
    if (!k.imu_from_previous) continue;
    const auto it = std::find(keyframes_.begin(), keyframes_.end(), k.previous);
    if (it == keyframes_.end()) continue;
    const auto from = static_cast<int>(it - keyframes_.begin());
    const bool both_fixed =
        problem_.poses[to].pose_fixed && problem_.poses[static_cast<std::size_t>(from)].pose_fixed;
    if (!both_fixed)
      problem_.imu_edges.push_back({from, static_cast<int>(to), k.imu_from_previous});
  }
}

void MapAdjustment::apply(map::Map& map, const optimization::BundleResult& result) const {
  if (!result.usable) {
    logger("mapping").warn("bundle adjustment not applied: {}", result.reason);
    return;
  }
  for (std::size_t i = 0; i < keyframes_.size(); ++i) {
    const optimization::BundlePose& pose = problem_.poses[i];
    if (!pose.pose_fixed || !pose.motion_fixed) map.set_state(keyframes_[i], pose.state);
  }
  for (std::size_t p = 0; p < landmarks_.size(); ++p)
    map.set_p_world(landmarks_[p], problem_.points[p]);
  for (std::size_t i = 0; i < seen_.size(); ++i) {
    if (!result.outlier[i]) continue;
    const LandmarkId id = landmarks_[static_cast<std::size_t>(problem_.observations[i].point)];
    if (map.contains(id)) map.remove_observation(id, seen_[i].keyframe);
  }
}

optimization::BundleResult adjust_locally(map::Map& map, KeyframeId keyframe, bool inertial,
                                          const MappingOptions& options,
                                          const std::atomic<bool>* cancel) {
  std::vector<KeyframeId> free{keyframe}, fixed;
  const KeyframeId first = map.map_info(map.keyframe(keyframe).map).first_keyframe;
  if (inertial) {
    while (free.size() < options.window_keyframes_inertial &&
           map.keyframe(free.back()).previous.valid())
      free.push_back(map.keyframe(free.back()).previous);
    const KeyframeId before = map.keyframe(free.back()).previous;
    if (before.valid()) {
      fixed.push_back(before);
    } else if (free.size() > 1) {
      fixed.push_back(free.back());
      free.pop_back();
    }
  } else {
    for (const KeyframeId id : map.best_covisible(keyframe, options.window_keyframes - 1, 15))
      if (id != first) free.push_back(id);
    if (keyframe == first) return {};
  }
  for (const KeyframeId id : best_outside(map, free, options.fixed_keyframes))
    if (!is_in(fixed, id)) fixed.push_back(id);
  if (fixed.empty() && free.size() > 1) {
    fixed.push_back(free.back());
    free.pop_back();
  }
  MapAdjustment adjustment(map, free, fixed, inertial, options.max_window_points);
  optimization::BundleOptions rule;
  rule.iterations = options.adjustment_iterations;
  rule.iterations_after_gate = options.adjustment_iterations_after_gate;
  rule.threads = options.threads;
  rule.cancel = cancel;
  const auto result = optimization::adjust_bundle(adjustment.problem(), rule);
  adjustment.apply(map, result);
  return result;
}

optimization::BundleResult adjust_whole_map(map::Map& map, MapId id, bool inertial, int iterations,
                                            const MappingOptions& options,
                                            const std::atomic<bool>* cancel) {
  std::vector<KeyframeId> free;
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i)
    if (map.contains(KeyframeId(i)) && map.keyframe(KeyframeId(i)).map == id)
      free.push_back(KeyframeId(i));
  std::vector<KeyframeId> fixed;
  if (!inertial && !free.empty()) {
    fixed.push_back(free.front());
    free.erase(free.begin());
  }
  MapAdjustment adjustment(map, free, fixed, inertial, map.num_landmarks());
  optimization::BundleOptions rule;
  rule.iterations = iterations;
  rule.iterations_after_gate = 0;
  rule.threads = options.threads;
  rule.cancel = cancel;
  const auto result = optimization::adjust_bundle(adjustment.problem(), rule);
  adjustment.apply(map, result);
  return result;
}

}  // namespace fastloop::mapping
