#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/loop/region_match.hpp"
#include "fastloop/loop/similarity_ransac.hpp"
#include "fastloop/map/landmark_arrays.hpp"
#include "fastloop/optimization/similarity_refinement.hpp"

/// From matches of a keyframe with another part of the map to the flat problems of the solvers.
namespace fastloop::loop {

/// A landmark of the current keyframe and one of the other side that look the same.
struct LandmarkPair {
  std::uint32_t keypoint = 0;  ///< of the current keyframe
  LandmarkId landmark;         ///< other side
  KeyframeId view;             ///< other side's keyframe in which it was matched
  std::uint32_t view_keypoint = 0;
};

/// [num_keypoints] 1 where the keyframe has no landmark.
std::vector<std::uint8_t> keypoints_without_landmark(const map::Snapshot& snapshot,
                                                     KeyframeId keyframe);

/// Joins the matches of one keyframe with several others: each keypoint and each landmark takes part
/// once, the first keyframe that offers a pair wins.
class PairCollector {
 public:
  PairCollector(const map::Snapshot& snapshot, KeyframeId current);
  /// @param matches  [keypoints of current] keypoint of `view` or kNoMatch
  void add(KeyframeId view, std::span<const std::int32_t> matches);
  std::vector<LandmarkPair> take() { return std::move(pairs_); }

 private:
  const map::Snapshot& snapshot_;
  std::vector<std::uint8_t> keypoint_used_;
  std::vector<LandmarkId> used_;  ///< ascending
  std::vector<LandmarkPair> pairs_;
};

/// First side: camera of `current`; second side: world with its origin moved to the camera of
/// `candidate`.
SimilarityPairs make_similarity_pairs(const map::Snapshot& snapshot, KeyframeId current,
                                      KeyframeId candidate, std::span<const LandmarkPair> pairs,
                                      double gate_chi2);

/// Pairs of the landmarks found in `current` with its own landmarks at the same keypoints. The view
/// of the second side is the first keyframe of `window` that sees the landmark.
/// @param found  landmarks of `cloud`; the pairs come in this order
std::vector<optimization::SimilarityPair> make_refinement_pairs(
    const map::Snapshot& snapshot, KeyframeId current, std::span<const KeyframeId> window,
    const map::LandmarkArrays& cloud, std::span<const matching::KeypointMatch> found);

RegionMatch make_region_match(const map::Snapshot& snapshot, KeyframeId current, KeyframeId matched,
                              const SE3& T_camera_world, const map::LandmarkArrays& cloud,
                              std::span<const matching::KeypointMatch> found);

}  // namespace fastloop::loop
