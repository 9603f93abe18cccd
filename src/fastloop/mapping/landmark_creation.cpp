#include "fastloop/mapping/landmark_creation.hpp"

#include <algorithm>
#include <cmath>

#include "fastloop/geometry/triangulation.hpp"
#include "fastloop/matching/descriptor_matching.hpp"

namespace fastloop::mapping {
namespace {

constexpr double kMaxParallaxCosine = 0.9998;  ///< rays closer than about a degree give no depth
constexpr double kScaleTolerance = 1.5;  ///< times the scale factor: octaves must fit the distances

/// One keyframe of a pair to triangulate between.
struct View {
  const map::Map& map;
  KeyframeId id;
  const FeatureSet& features;
  SE3 T_world_camera;

  View(const map::Map& m, KeyframeId k)
      : map(m),
        id(k),
        features(*m.keyframe(k).data->features),
        T_world_camera(m.T_world_camera(k)) {}

  Vector3d ray(std::uint32_t i) const {
    return map.rig().left.unproject({features.x[i], features.y[i]});
  }
  Vector3d stereo_point(std::uint32_t i) const {
    return T_world_camera *
           map.rig().point_at_depth({features.x[i], features.y[i]}, features.depth_m[i]);
  }
  /// Cosine of the parallax that the stereo baseline alone gives; 1 without depth.
  double stereo_cosine(std::uint32_t i) const {
    if (!features.has_depth(i)) return 1;
    return std::cos(2 * std::atan2(map.rig().baseline_m / 2, features.depth_m[i]));
  }
  bool agrees(std::uint32_t i, const Vector3d& p_world) const {
    StereoRig::Residual r;
    const PixelObservation z = map.pixel(id, i);
    const int n = map.rig().residual(T_world_camera.inverse() * p_world, z, &r);
    return n > 0 &&
           r.head(n).squaredNorm() < chi2_gate(n) * map.scales().sigma2[features.octave[i]];
  }
  double distance(const Vector3d& p_world) const {
    return (p_world - T_world_camera.translation).norm();
  }
};

/// The point of a pair of keypoints from whatever sees it under the largest angle: the two
/// keyframes, or the stereo of one of them.
std::optional<Vector3d> locate(const View& a, std::uint32_t i, const View& b, std::uint32_t j) {
  const SE3 T_b_a = b.T_world_camera.inverse() * a.T_world_camera;
  const double cosine = parallax_cosine(a.ray(i), b.ray(j), T_b_a.rotation);
  const double stereo_a = a.stereo_cosine(i), stereo_b = b.stereo_cosine(j);
  if (cosine > 0 && cosine < std::min({stereo_a, stereo_b, kMaxParallaxCosine})) {
    const auto p = triangulate_midpoint(a.ray(i), b.ray(j), T_b_a);
    if (!p || p->dot(a.ray(i)) <= 0) return std::nullopt;
    return a.T_world_camera * *p;
  }
  if (stereo_a < 1 && stereo_a <= stereo_b) return a.stereo_point(i);
  if (stereo_b < 1) return b.stereo_point(j);
  return std::nullopt;
}

bool scale_fits(const View& a, std::uint32_t i, const View& b, std::uint32_t j, const Vector3d& p) {
  const auto& scale = a.map.scales().scale;
  const double by_distance = b.distance(p) / a.distance(p);
  const double by_octave = scale[b.features.octave[j]] / scale[a.features.octave[i]];
  const double tolerance = kScaleTolerance * a.map.scales().factor;
  return by_distance < by_octave * tolerance && by_octave < by_distance * tolerance;
}

std::vector<std::uint8_t> occupied(const map::Keyframe& k) {
  std::vector<std::uint8_t> taken(k.landmarks.size());
  for (std::size_t i = 0; i < taken.size(); ++i) taken[i] = k.landmarks[i].valid();
  return taken;
}

}  // namespace

std::vector<LandmarkId> create_from_stereo(map::Map& map, KeyframeId id,
                                           const MappingOptions& options) {
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
    const Vector3d p_left = rig.point_at_depth({features->x[i], features->y[i]}, depth);
    created.push_back(map.add_landmark(id, i, T_world_camera * p_left));
  }
  return created;
}

std::vector<LandmarkId> create_by_triangulation(map::Map& map, KeyframeId id,
                                                const MappingOptions& options) {
  std::vector<LandmarkId> created;
  const View here(map, id);
  const matching::Bearings bearings = matching::compute_bearings(map.rig().left, here.features);
  for (const KeyframeId neighbour : map.best_covisible(id, options.triangulation_neighbours)) {
    const View there(map, neighbour);
    if ((there.T_world_camera.translation - here.T_world_camera.translation).norm() <
        map.rig().baseline_m)
      continue;
    const std::vector<std::uint8_t> taken_here = occupied(map.keyframe(id)),
                                    taken_there = occupied(map.keyframe(neighbour));
    matching::TriangulationSide first{
        {&here.features, nullptr, taken_here}, here.T_world_camera.inverse(), &bearings};
    matching::TriangulationSide second{
        {&there.features, nullptr, taken_there}, there.T_world_camera.inverse(), nullptr};
    for (const matching::IndexPair& pair : matching::search_for_triangulation(
             Executor::cpu(), map.rig(), map.scales(), first, second)) {
      const auto i = static_cast<std::uint32_t>(pair.first),
                 j = static_cast<std::uint32_t>(pair.second);
      const auto p = locate(here, i, there, j);
      if (!p || !p->allFinite() || !here.agrees(i, *p) || !there.agrees(j, *p) ||
          !scale_fits(here, i, there, j, *p))
        continue;
      const LandmarkId landmark = map.add_landmark(id, i, *p);
      map.add_observation(landmark, neighbour, j);
      map.refresh_landmark(landmark);
      created.push_back(landmark);
    }
  }
  return created;
}

}  // namespace fastloop::mapping
