#include "fastloop/tracking/relocalizer.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <random>

#include "fastloop/optimization/pose_only.hpp"

namespace fastloop::tracking {
namespace {

constexpr int kKeyframesPerCall = 12;
constexpr int kMaxDistance = 60;  ///< Hamming
constexpr double kRatio = 0.8;
constexpr int kRansacIterations = 200;
constexpr double kRelativeTolerance = 0.06;  ///< of the depth: stereo noise of a distant point

struct Pair {
  std::uint32_t keypoint;
  LandmarkId landmark;
  Vector3d p_body, p_world;
};

/// Best landmark of a keyframe for every keypoint with depth, one to one.
std::vector<Pair> match(const map::Snapshot& snapshot, const FeatureSet& f, KeyframeId id) {
  const map::Keyframe& k = snapshot.keyframe(id);
  const FeatureSet& kf = *k.data->features;
  std::vector<std::uint32_t> owners;
  for (std::uint32_t i = 0; i < k.landmarks.size(); ++i)
    if (k.landmarks[i].valid()) owners.push_back(i);
  std::vector<std::pair<int, std::uint32_t>> claim(k.landmarks.size(), {257, 0});
  const StereoRig& rig = snapshot.rig();
  for (std::uint32_t i = 0; i < f.size(); ++i) {
    if (!f.has_depth(i)) continue;
    int best = 257, second = 257;
    std::uint32_t best_owner = 0;
    for (const std::uint32_t o : owners) {
      const int d = hamming_distance(f.descriptors[i], kf.descriptors[o]);
      if (d < best) {
        second = best;
        best = d;
        best_owner = o;
      } else if (d < second) {
        second = d;
      }
    }
    if (best > kMaxDistance || best >= kRatio * second) continue;
    claim[best_owner] = std::min(claim[best_owner], {best, i});
  }
  std::vector<Pair> pairs;
  for (const std::uint32_t o : owners) {
    if (claim[o].first > kMaxDistance) continue;
    const std::uint32_t i = claim[o].second;
    const Vector3d p_left = rig.point_at_depth({f.x[i], f.y[i]}, f.depth_m[i]);
    pairs.push_back(
        {i, k.landmarks[o], rig.T_body_left * p_left, snapshot.p_world(k.landmarks[o])});
  }
  return pairs;
}

SE3 align(const std::vector<Pair>& pairs, const std::array<std::size_t, 3>& pick) {
  Eigen::Matrix3d body, world;
  for (int c = 0; c < 3; ++c) {
    body.col(c) = pairs[pick[static_cast<std::size_t>(c)]].p_body;
    world.col(c) = pairs[pick[static_cast<std::size_t>(c)]].p_world;
  }
  return SE3::from_matrix(Eigen::umeyama(body, world, false));
}

int count_inliers(const std::vector<Pair>& pairs, const SE3& T_world_body) {
  int n = 0;
  for (const Pair& p : pairs)
    n += (T_world_body * p.p_body - p.p_world).norm() < 0.03 + kRelativeTolerance * p.p_body.norm();
  return n;
}

}  // namespace

std::vector<KeyframeId> Relocalizer::candidates(const map::Snapshot& snapshot,
                                                const FeatureSet& features, MapId map,
                                                KeyframeId near) {
  std::vector<KeyframeId> ids;
  const auto add = [&](KeyframeId id) {
    if (snapshot.contains(id) && snapshot.keyframe(id).map == map &&
        std::find(ids.begin(), ids.end(), id) == ids.end())
      ids.push_back(id);
  };
  add(near);
  if (snapshot.contains(near))
    for (const KeyframeId id : snapshot.best_covisible(near, kKeyframesPerCall / 2 - 1)) add(id);
  if (source_)
    for (const KeyframeId id : source_(features, snapshot)) add(id);
  const auto slots = static_cast<std::uint32_t>(snapshot.keyframe_slots());
  for (std::uint32_t tried = 0; tried < slots && ids.size() < kKeyframesPerCall; ++tried)
    add(KeyframeId(next_++ % slots));
  return ids;
}

std::optional<Relocation> Relocalizer::try_keyframe(const map::Snapshot& snapshot,
                                                    const FeatureSet& features,
                                                    KeyframeId candidate, int min_inliers) {
  const std::vector<Pair> pairs = match(snapshot, features, candidate);
  if (static_cast<int>(pairs.size()) < min_inliers) return std::nullopt;
  std::mt19937 rng(candidate.value());
  SE3 best;
  int best_count = 0;
  for (int i = 0; i < kRansacIterations; ++i) {
    std::array<std::size_t, 3> pick;
    for (auto& p : pick) p = rng() % pairs.size();
    if (pick[0] == pick[1] || pick[1] == pick[2] || pick[0] == pick[2]) continue;
    const SE3 T = align(pairs, pick);
    const int count = count_inliers(pairs, T);
    if (count > best_count) {
      best_count = count;
      best = T;
    }
  }
  if (best_count < std::max(10, min_inliers / 2)) return std::nullopt;

  std::vector<optimization::PoseObservation> observations;
  for (const Pair& p : pairs) {
    optimization::PoseObservation o;
    o.p_world = p.p_world;
    o.pixel.left = {features.x[p.keypoint], features.y[p.keypoint]};
    o.pixel.right = {features.right_x[p.keypoint], features.right_y[p.keypoint]};
    o.inv_sigma2 = 1.0 / snapshot.scales().sigma2[features.octave[p.keypoint]];
    observations.push_back(o);
  }
  const auto refined = optimization::optimize_pose(snapshot.rig(), best, observations);
  if (refined.num_inliers < min_inliers) return std::nullopt;
  Relocation result;
  result.T_world_body = refined.T_world_body;
  result.keyframe = candidate;
  result.inliers = refined.num_inliers;
  result.landmarks.assign(features.size(), LandmarkId{});
  for (std::size_t i = 0; i < pairs.size(); ++i)
    if (refined.inlier[i]) result.landmarks[pairs[i].keypoint] = pairs[i].landmark;
  return result;
}

std::optional<Relocation> Relocalizer::relocalise(const map::Snapshot& snapshot,
                                                  const FeatureSet& features, MapId map,
                                                  KeyframeId near, int min_inliers) {
  for (const KeyframeId id : candidates(snapshot, features, map, near))
    if (auto found = try_keyframe(snapshot, features, id, min_inliers)) return found;
  return std::nullopt;
}

}  // namespace fastloop::tracking
