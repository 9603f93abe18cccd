#include "fastloop/loop/keyframe_search.hpp"

namespace fastloop::loop {
namespace {

void add_targets(const map::Snapshot& snapshot, std::span<const MovedKeyframe> moved,
                 std::vector<matching::SearchTarget>& targets) {
  for (const MovedKeyframe& m : moved) {
    matching::SearchTarget& target = targets.emplace_back();
    target.features = snapshot.keyframe(m.keyframe).data->features.get();
    target.T_camera_world = m.T_camera_world;
  }
}

matching::ProjectionSearchOptions rule_of(float radius_px, int max_distance) {
  matching::ProjectionSearchOptions rule;
  rule.radius_px = radius_px;
  rule.max_distance = max_distance;
  return rule;
}

}  // namespace

std::vector<matching::ProjectionMatches> search_keyframes(const StepExecutors& executors,
                                                          const map::Snapshot& snapshot,
                                                          std::span<const MovedKeyframe> moved,
                                                          const map::LandmarkArrays& cloud,
                                                          float radius_px, int max_distance) {
  std::vector<matching::SearchTarget> targets;
  add_targets(snapshot, moved, targets);
  std::vector<matching::ProjectionMatches> found(moved.size());
  const auto work = static_cast<double>(cloud.size() * moved.size());
  matching::search_by_projection(executors.of(Step::kProjection, work), snapshot.rig(),
                                 snapshot.scales(), targets, cloud.view(),
                                 rule_of(radius_px, max_distance), found);
  return found;
}

matching::MatchLists find_in_keyframes(const StepExecutors& executors,
                                       const map::Snapshot& snapshot,
                                       std::span<const PlaceSearch> places, float radius_px,
                                       int max_distance) {
  std::size_t work = 0;
  std::vector<matching::SearchTarget> targets;
  for (const PlaceSearch& place : places) {
    work += place.cloud->size() * place.moved.size();
    add_targets(snapshot, place.moved, targets);
  }
  const Executor& executor = executors.of(Step::kProjection, static_cast<double>(work));
  std::vector<matching::ProjectionJob> jobs;
  std::size_t first = 0;
  for (const PlaceSearch& place : places) {
    matching::LandmarkView view = place.cloud->view();
    if (place.resident) {
      if (!*place.resident) *place.resident = matching::make_resident(executor, view);
      view.resident = place.resident->get();
    }
    jobs.push_back({view, std::span(targets).subspan(first, place.moved.size())});
    first += place.moved.size();
  }
  return matching::find_by_projection(executor, snapshot.rig(), snapshot.scales(), jobs,
                                      rule_of(radius_px, max_distance));
}

}  // namespace fastloop::loop
