#include "fastloop/mapping/landmark_fusion.hpp"

#include <algorithm>

#include "fastloop/map/landmark_arrays.hpp"

namespace fastloop::mapping {
namespace {

/// Searches the landmarks in all keyframes at once and applies what was found, keyframe by
/// keyframe.
int fuse_into(map::Map& map, const std::vector<KeyframeId>& keyframes,
              const std::vector<LandmarkId>& ids) {
  if (keyframes.empty() || ids.empty()) return 0;
  const map::LandmarkArrays arrays(map, ids);
  std::vector<std::vector<std::uint8_t>> skipped(keyframes.size());
  std::vector<matching::SearchTarget> targets(keyframes.size());
  for (std::size_t t = 0; t < keyframes.size(); ++t) {
    skipped[t].assign(ids.size(), 0);
    for (const LandmarkId seen : map.keyframe(keyframes[t]).landmarks) {
      const auto it = seen.valid() ? std::lower_bound(ids.begin(), ids.end(), seen) : ids.end();
      if (it != ids.end() && *it == seen)
        skipped[t][static_cast<std::size_t>(it - ids.begin())] = 1;
    }
    targets[t].features = map.keyframe(keyframes[t]).data->features.get();
    targets[t].T_camera_world = map.T_world_camera(keyframes[t]).inverse();
    targets[t].landmark_skipped = skipped[t];
  }
  matching::ProjectionSearchOptions rule;
  rule.radius_px = 3;
  rule.max_distance = 50;
  rule.chi2_gate_mono = 5.99f;
  rule.chi2_gate_stereo = 7.8f;
  std::vector<matching::ProjectionMatches> found(targets.size());
  matching::search_by_projection(Executor::cpu(), map.rig(), map.scales(), targets, arrays.view(),
                                 rule, found);

  int changes = 0;
  for (std::size_t t = 0; t < keyframes.size(); ++t)
    for (std::size_t i = 0; i < ids.size(); ++i) {
      if (found[t].keypoint[i] == matching::kNoMatch) continue;
      const auto keypoint = static_cast<std::uint32_t>(found[t].keypoint[i]);
      const LandmarkId id = map.resolve(ids[i]);
      if (!id.valid()) continue;
      const LandmarkId there = map.keyframe(keyframes[t]).landmarks[keypoint];
      if (!there.valid()) {
        changes += map.add_observation(id, keyframes[t], keypoint);
      } else if (there != id) {
        const bool keep_there =
            map.landmark(there).observations.size() > map.landmark(id).observations.size();
        map.replace_landmark(keep_there ? id : there, keep_there ? there : id);
        ++changes;
      }
    }
  return changes;
}

}  // namespace

int fuse_with_neighbours(map::Map& map, KeyframeId keyframe, const MappingOptions& options) {
  std::vector<KeyframeId> neighbours = map.best_covisible(keyframe, options.fusion_neighbours);
  const std::size_t direct = neighbours.size();
  for (std::size_t i = 0; i < direct; ++i)
    for (const KeyframeId second : map.best_covisible(neighbours[i], 3))
      if (second != keyframe &&
          std::find(neighbours.begin(), neighbours.end(), second) == neighbours.end())
        neighbours.push_back(second);
  const KeyframeId previous = map.keyframe(keyframe).previous;
  if (previous.valid() &&
      std::find(neighbours.begin(), neighbours.end(), previous) == neighbours.end())
    neighbours.push_back(previous);

  int changes = fuse_into(map, neighbours, map::landmarks_of(map, {{keyframe}}));
  changes += fuse_into(map, {keyframe}, map::landmarks_of(map, neighbours));
  for (const LandmarkId id : map::landmarks_of(map, {{keyframe}})) map.refresh_landmark(id);
  return changes;
}

}  // namespace fastloop::mapping
