#include "fastloop/loop/keyframe_search.hpp"

namespace fastloop::loop {

std::vector<matching::ProjectionMatches> search_keyframes(const StepExecutors& executors,
                                                          const map::Snapshot& snapshot,
                                                          std::span<const MovedKeyframe> moved,
                                                          const map::LandmarkArrays& cloud,
                                                          float radius_px, int max_distance) {
  std::vector<matching::SearchTarget> targets(moved.size());
  for (std::size_t t = 0; t < moved.size(); ++t) {
    targets[t].features = snapshot.keyframe(moved[t].keyframe).data->features.get();
    targets[t].T_camera_world = moved[t].T_camera_world;
  }
  matching::ProjectionSearchOptions rule;
  rule.radius_px = radius_px;
  rule.max_distance = max_distance;
  std::vector<matching::ProjectionMatches> found(moved.size());
  const auto work = static_cast<double>(cloud.size()) * static_cast<double>(moved.size());
  matching::search_by_projection(executors.of(Step::kProjection, work), snapshot.rig(),
                                 snapshot.scales(), targets, cloud.view(), rule, found);
  return found;
}

}  // namespace fastloop::loop
