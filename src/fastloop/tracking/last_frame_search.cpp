#include "fastloop/tracking/last_frame_search.hpp"

#include <algorithm>
#include <cmath>

namespace fastloop::tracking {
namespace {

struct Source {
  LandmarkId landmark;
  Vector3d p_world;
  std::uint32_t keypoint;
};

std::vector<Source> collect_sources(const map::Snapshot& snapshot, const TrackedFrame& last,
                                    float close_depth_m) {
  std::vector<Source> sources;
  const StereoRig& rig = snapshot.rig();
  const SE3 T_world_camera = last.state.T_world_body * rig.T_body_left;
  const FeatureSet& f = *last.features;
  for (std::uint32_t i = 0; i < f.size(); ++i) {
    const LandmarkId id = snapshot.resolve(last.landmarks[i]);
    if (id.valid()) {
      sources.push_back({id, snapshot.p_world(id), i});
    } else if (f.has_depth(i) && f.depth_m[i] < close_depth_m) {
      const Vector3d p_left = rig.point_at_depth({f.x[i], f.y[i]}, f.depth_m[i]);
      sources.push_back({{}, T_world_camera * p_left, i});
    }
  }
  return sources;
}

}  // namespace

std::vector<PointMatch> search_last_frame(const map::Snapshot& snapshot, const TrackedFrame& last,
                                          const FeatureSet& features,
                                          const SE3& predicted_T_world_body, float radius_px,
                                          float close_depth_m) {
  const StereoRig& rig = snapshot.rig();
  const PyramidScales& scales = snapshot.scales();
  const SE3 T_camera_world = (predicted_T_world_body * rig.T_body_left).inverse();
  const std::vector<Source> sources = collect_sources(snapshot, last, close_depth_m);

  std::vector<matching::WindowQuery> queries;
  std::vector<std::size_t> source_of;
  queries.reserve(sources.size());
  for (std::size_t s = 0; s < sources.size(); ++s) {
    const Vector3d p_camera = T_camera_world * sources[s].p_world;
    if (!rig.left.is_projectable(p_camera)) continue;
    const Eigen::Vector2d pixel = rig.left.project(p_camera);
    if (!rig.left.contains(pixel)) continue;
    const std::uint32_t i = sources[s].keypoint;
    const int octave = last.features->octave[i];
    matching::WindowQuery q;
    q.pixel = pixel.cast<float>();
    q.right_x = rig.kind == StereoRig::Kind::kRectified
                    ? static_cast<float>(pixel.x() - rig.left.fx * rig.baseline_m / p_camera.z())
                    : std::nanf("");
    q.radius_px = radius_px * scales.scale[static_cast<std::size_t>(octave)];
    q.min_octave = static_cast<std::int16_t>(octave - 1);
    q.max_octave = static_cast<std::int16_t>(octave + 1);
    q.descriptor = last.features->descriptors[i];
    q.angle_rad = last.features->angle_rad[i];
    queries.push_back(q);
    source_of.push_back(s);
  }
  const std::vector<std::int32_t> found =
      matching::search_windows(Executor::cpu(), features, queries, matching::WindowSearchOptions{});
  std::vector<PointMatch> matches;
  for (std::size_t q = 0; q < queries.size(); ++q) {
    if (found[q] == matching::kNoMatch) continue;
    const Source& source = sources[source_of[q]];
    matches.push_back({static_cast<std::uint32_t>(found[q]), source.landmark, source.p_world});
  }
  return matches;
}

}  // namespace fastloop::tracking
