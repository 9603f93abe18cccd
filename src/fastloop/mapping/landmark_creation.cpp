#include "fastloop/mapping/landmark_creation.hpp"

#include <algorithm>

namespace fastloop::mapping {

std::vector<LandmarkId> create_from_stereo(map::Map& map, KeyframeId id, const MappingOptions& options) {
  const map::Keyframe& k = map.keyframe(id);
  const std::shared_ptr<const FeatureSet> features = k.data->features;
  const StereoRig& rig = map.rig();
  std::vector<std::pair<float, std::uint32_t>> by_depth;
  for (std::uint32_t i = 0; i < features->size(); ++i)
    if (features->has_depth(i)) by_depth.emplace_back(features->depth_m[i], i);
  std::sort(by_depth.begin(), by_depth.end());

  const double close_m = options.close_depth_baselines * rig.baseline_m;
  const SE3 T_world_camera = map.T_world_camera(id);
  std::vector<LandmarkId> created;
  std::size_t considered = 0;
  for (const auto& [depth, i] : by_depth) {
    if (depth > close_m && considered >= options.min_stereo_landmarks) break;
    ++considered;
    if (map.keyframe(id).landmarks[i].valid()) continue;
    const Vector3d ray = rig.left.unproject({features->x[i], features->y[i]});
    created.push_back(map.add_landmark(id, i, T_world_camera * Vector3d(ray * (depth / ray.z()))));
  }
  return created;
}

}  // namespace fastloop::mapping
