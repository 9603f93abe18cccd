#include "fastloop/loop/correspondences.hpp"

#include <algorithm>
#include <map>

namespace fastloop::loop {

using map::Observation;
using map::Snapshot;

std::vector<std::uint8_t> keypoints_without_landmark(const Snapshot& snapshot,
                                                     KeyframeId keyframe) {
  const std::vector<LandmarkId>& landmarks = snapshot.keyframe(keyframe).landmarks;
  std::vector<std::uint8_t> mask(landmarks.size());
  for (std::size_t i = 0; i < mask.size(); ++i) mask[i] = !landmarks[i].valid();
  return mask;
}

PairCollector::PairCollector(const Snapshot& snapshot, KeyframeId current)
    : snapshot_(snapshot), keypoint_used_(snapshot.keyframe(current).landmarks.size(), 0) {}

void PairCollector::add(KeyframeId view, std::span<const std::int32_t> matches) {
  const std::vector<LandmarkId>& landmarks = snapshot_.keyframe(view).landmarks;
  for (std::uint32_t i = 0; i < matches.size(); ++i) {
    if (matches[i] == matching::kNoMatch || keypoint_used_[i]) continue;
    const auto there = static_cast<std::uint32_t>(matches[i]);
    const auto at = std::lower_bound(used_.begin(), used_.end(), landmarks[there]);
    if (at != used_.end() && *at == landmarks[there]) continue;
    used_.insert(at, landmarks[there]);
    keypoint_used_[i] = 1;
    pairs_.push_back({i, landmarks[there], view, there});
  }
}

SimilarityPairs make_similarity_pairs(const Snapshot& snapshot, KeyframeId current,
                                      KeyframeId candidate, std::span<const LandmarkPair> pairs,
                                      double gate_chi2) {
  SimilarityPairs out;
  const map::Keyframe& k = snapshot.keyframe(current);
  const FeatureSet& f = *k.data->features;
  const SE3 T_current_world = snapshot.T_world_camera(current).inverse();
  const Vector3d origin = snapshot.T_world_camera(candidate).translation;
  const SE3 T_world_local(Eigen::Quaterniond::Identity(), origin);
  std::map<KeyframeId, std::int32_t> view_index;
  const auto push = [](std::vector<float>& to, const auto& v) {
    for (Eigen::Index i = 0; i < v.size(); ++i) to.push_back(static_cast<float>(v[i]));
  };
  const auto gate = [&](const FeatureSet& features, std::uint32_t keypoint) {
    return static_cast<float>(gate_chi2) * snapshot.scales().sigma2[features.octave[keypoint]];
  };
  for (const LandmarkPair& p : pairs) {
    const auto [it, added] =
        view_index.emplace(p.view, static_cast<std::int32_t>(out.views.size()));
    if (added) {
      const SE3 T = snapshot.T_world_camera(p.view).inverse() * T_world_local;
      const Matrix3d r = T.rotation.toRotationMatrix();
      ViewPose pose;
      for (int i = 0; i < 9; ++i) pose.rotation[i] = static_cast<float>(r(i / 3, i % 3));
      for (int i = 0; i < 3; ++i) pose.translation[i] = static_cast<float>(T.translation[i]);
      out.views.push_back(pose);
    }
    const FeatureSet& fv = *snapshot.keyframe(p.view).data->features;
    push(out.p_first, T_current_world * snapshot.p_world(k.landmarks[p.keypoint]));
    push(out.pixel_first, Eigen::Vector2f(f.x[p.keypoint], f.y[p.keypoint]));
    out.gate_first.push_back(gate(f, p.keypoint));
    push(out.p_second, Vector3d(snapshot.p_world(p.landmark) - origin));
    out.view.push_back(it->second);
    push(out.pixel_view, Eigen::Vector2f(fv.x[p.view_keypoint], fv.y[p.view_keypoint]));
    out.gate_view.push_back(gate(fv, p.view_keypoint));
  }
  return out;
}

std::vector<optimization::SimilarityPair> make_refinement_pairs(
    const Snapshot& snapshot, KeyframeId current, std::span<const KeyframeId> window,
    const map::LandmarkArrays& cloud, std::span<const matching::KeypointMatch> found) {
  const map::Keyframe& k = snapshot.keyframe(current);
  const SE3 T_current_world = snapshot.T_world_camera(current).inverse();
  const auto inv_sigma2 = [&](KeyframeId id, std::uint32_t keypoint) {
    return 1.0 / snapshot.scales().sigma2[snapshot.keyframe(id).data->features->octave[keypoint]];
  };
  std::vector<SE3> T_view_world;
  for (const KeyframeId id : window) T_view_world.push_back(snapshot.T_world_camera(id).inverse());

  std::vector<optimization::SimilarityPair> pairs;
  for (const matching::KeypointMatch& match : found) {
    const LandmarkId own = k.landmarks[match.keypoint];
    if (!own.valid()) continue;
    const LandmarkId landmark = cloud.ids[match.landmark];
    const std::vector<Observation>& seen = snapshot.landmark(landmark).observations;
    for (std::size_t w = 0; w < window.size(); ++w) {
      const auto o = std::lower_bound(seen.begin(), seen.end(), window[w],
                                      [](const Observation& a, KeyframeId b) { return a.keyframe < b; });
      if (o == seen.end() || o->keyframe != window[w]) continue;
      optimization::SimilarityPair p;
      p.p_first = T_current_world * snapshot.p_world(own);
      p.p_second = snapshot.p_world(landmark);
      p.pixel_first = snapshot.pixel(current, match.keypoint).left;
      p.inv_sigma2_first = inv_sigma2(current, match.keypoint);
      p.T_view_second = T_view_world[w];
      p.pixel_view = snapshot.pixel(window[w], o->keypoint).left;
      p.inv_sigma2_view = inv_sigma2(window[w], o->keypoint);
      pairs.push_back(p);
      break;
    }
  }
  return pairs;
}

RegionMatch make_region_match(const Snapshot& snapshot, KeyframeId current, KeyframeId matched,
                              const SE3& T_camera_world, const map::LandmarkArrays& cloud,
                              std::span<const matching::KeypointMatch> found) {
  RegionMatch match;
  match.current = current;
  match.matched = matched;
  match.merge = snapshot.keyframe(current).map != snapshot.keyframe(matched).map;
  match.T_camera_world = T_camera_world;
  match.landmarks.assign(snapshot.keyframe(current).landmarks.size(), LandmarkId{});
  for (const matching::KeypointMatch& m : found) match.landmarks[m.keypoint] = cloud.ids[m.landmark];
  match.num_matches = static_cast<int>(found.size());
  return match;
}

}  // namespace fastloop::loop
