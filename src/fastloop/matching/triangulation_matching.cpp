#include <cmath>
#include <optional>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/candidate_lists.hpp"
#include "fastloop/matching/claims.hpp"
#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/matching/rotation_histogram.hpp"

namespace fastloop::matching {
namespace {

constexpr std::size_t kGrain = 16;  // keypoints worth a task
constexpr int kBatch = 128;
constexpr double kMinBaseline_m = 1e-9;

/// Two views of a pair of cameras, and what decides whether two keypoints can be one point.
struct EpipolarGate {
  Eigen::Matrix3f R_second_first;
  Eigen::Vector3f baseline;  ///< unit, direction of the first centre seen from the second
  const FeatureSet *first, *second;
  const Bearings *first_rays, *second_rays;
  const PyramidScales* scales;
  float focal_px, chi2, min_epipole_px;

  /// Unit normal of the epipolar plane of keypoint `i`; zero for a ray along the baseline.
  Eigen::Vector3f plane(std::size_t i) const {
    const Eigen::Vector3f n = baseline.cross(R_second_first * first_rays->ray[i]);
    const float norm = n.norm();
    return norm > 1e-6f ? Eigen::Vector3f(n / norm) : Eigen::Vector3f(Eigen::Vector3f::Zero());
  }

  bool accepts(std::size_t i, std::size_t k, const Eigen::Vector3f& normal) const {
    const Eigen::Vector3f& ray = second_rays->ray[k];
    const int octave = second->octave[k];
    if (!first->has_depth(i) && !second->has_depth(k)) {
      const float epipole_px = focal_px * baseline.cross(ray).norm();
      if (epipole_px < min_epipole_px * std::sqrt(scales->scale[octave])) return false;
    }
    // |offset| / |gradient| is the distance in pixels to the curve where the ray meets the plane.
    const float offset = normal.dot(ray);
    const Eigen::Vector2f gradient = second_rays->d_ray_d_pixel[k].transpose() * normal;
    return offset * offset <= chi2 * scales->sigma2[octave] * gradient.squaredNorm() &&
           gradient.squaredNorm() > 0;
  }
};

/// Nearest candidate that passes the gate.
template <class Distances>
MatchKey nearest(const EpipolarGate& gate, std::size_t i, std::span<const std::uint16_t> candidates,
                 int max_distance) {
  if (candidates.empty()) return kNoKey;
  const Eigen::Vector3f normal = gate.plane(i);
  std::uint16_t distance[kBatch];
  MatchKey best = static_cast<MatchKey>(max_distance + 1) << 16;
  bool found = false;
  for (std::size_t begin = 0; begin < candidates.size(); begin += kBatch) {
    const int n = static_cast<int>(std::min<std::size_t>(kBatch, candidates.size() - begin));
    Distances{}(gate.first->descriptors[i], gate.second->descriptors.data(),
                candidates.data() + begin, n, distance);
    for (int j = 0; j < n; ++j) {
      const MatchKey key = static_cast<MatchKey>(distance[j]) << 16 | candidates[begin + j];
      if (key >= best || !gate.accepts(i, candidates[begin + j], normal)) continue;
      best = key;
      found = true;
    }
  }
  return found ? best : kNoKey;
}

template <class Distances>
void match_all(const Executor& executor, const EpipolarGate& gate, const CandidateLists& lists,
               int max_distance, std::vector<MatchKey>& keys) {
  executor.for_ranges(keys.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      keys[i] = nearest<Distances>(gate, i, lists.of(i), max_distance);
  });
}

void check_octaves(const FeatureSet& features, const PyramidScales& scales) {
  for (const std::uint8_t octave : features.octave)
    if (octave >= scales.levels)
      throw InvalidArgument("search_for_triangulation: octave beyond the pyramid");
}

}  // namespace

Bearings compute_bearings(const Camera& camera, const FeatureSet& features) {
  Bearings b;
  b.ray.resize(features.size());
  b.d_ray_d_pixel.resize(features.size());
  for (std::size_t i = 0; i < features.size(); ++i) {
    const Vector3d ray = camera.unproject({features.x[i], features.y[i]});
    Eigen::Matrix<double, 2, 3> d_pixel;
    camera.project(ray, &d_pixel);
    // Inverse of the projection on the plane of directions across the ray.
    Eigen::Matrix<double, 3, 2> across;
    across.col(0) = ray.unitOrthogonal();
    across.col(1) = ray.cross(across.col(0));
    b.ray[i] = ray.cast<float>();
    b.d_ray_d_pixel[i] = (across * (d_pixel * across).inverse()).cast<float>();
  }
  return b;
}

std::vector<IndexPair> search_for_triangulation(const Executor& executor, const StereoRig& rig,
                                                const PyramidScales& scales,
                                                const TriangulationSide& first,
                                                const TriangulationSide& second,
                                                const TriangulationMatchOptions& options) {
  const CandidateLists lists(first.side, second.side);
  const SE3 T_second_first = second.T_camera_world * first.T_camera_world.inverse();
  if (!(T_second_first.translation.norm() > kMinBaseline_m)) return {};
  check_octaves(*second.side.features, scales);

  std::optional<Bearings> own_first, own_second;
  const auto rays_of = [&](const TriangulationSide& side, std::optional<Bearings>& own) {
    if (!side.bearings) own = compute_bearings(rig.left, *side.side.features);
    const Bearings& rays = side.bearings ? *side.bearings : *own;
    if (rays.ray.size() != side.side.features->size() ||
        rays.d_ray_d_pixel.size() != rays.ray.size())
      throw InvalidArgument("search_for_triangulation: one bearing per keypoint expected");
    return &rays;
  };
  EpipolarGate gate;
  gate.R_second_first = T_second_first.rotation.toRotationMatrix().cast<float>();
  gate.baseline = T_second_first.translation.normalized().cast<float>();
  gate.first = first.side.features;
  gate.second = second.side.features;
  gate.first_rays = rays_of(first, own_first);
  gate.second_rays = rays_of(second, own_second);
  gate.scales = &scales;
  gate.focal_px = static_cast<float>(rig.left.fx);
  gate.chi2 = options.epipolar_chi2;
  gate.min_epipole_px = options.min_epipole_px;

  std::vector<MatchKey> keys(first.side.features->size(), kNoKey);
  if (executor.kind() == Executor::Kind::kReference)
    match_all<PortableDistances>(executor, gate, lists, options.max_distance, keys);
  else
    match_all<CpuDistances>(executor, gate, lists, options.max_distance, keys);
  std::vector<std::int32_t> matches(keys.size());
  resolve_claims(keys, second.side.features->size(), matches, {});
  if (options.check_rotation)
    drop_odd_rotations(gate.first->angle_rad, gate.second->angle_rad, matches);
  std::vector<IndexPair> pairs;
  for (std::size_t i = 0; i < matches.size(); ++i)
    if (matches[i] != kNoMatch) pairs.push_back({static_cast<std::int32_t>(i), matches[i]});
  return pairs;
}

}  // namespace fastloop::matching
