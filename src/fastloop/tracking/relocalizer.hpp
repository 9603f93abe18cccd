#pragma once

#include <functional>
#include <optional>
#include <vector>

#include "fastloop/map/snapshot.hpp"

namespace fastloop::tracking {

struct Relocation {
  SE3 T_world_body;
  std::vector<LandmarkId> landmarks;  ///< [num_keypoints]
  KeyframeId keyframe;
  int inliers = 0;
};

/// Finds the pose of a frame in the map without a prediction: descriptor matches with candidate
/// keyframes, three-point rigid alignment (stereo points to landmarks) in a fixed-seed RANSAC,
/// pose-only refinement.
class Relocalizer {
 public:
  using CandidateSource = std::function<std::vector<KeyframeId>(const FeatureSet& features,
                                                                const map::Snapshot& snapshot)>;

  /// Each call tries the surroundings of `near`, then what the source names (keyframes that look
  /// like the frame, best first), then the next few keyframes in turn.
  void set_candidate_source(CandidateSource source) { source_ = std::move(source); }

  std::optional<Relocation> relocalise(const map::Snapshot& snapshot, const FeatureSet& features,
                                       MapId map, KeyframeId near, int min_inliers);

 private:
  std::vector<KeyframeId> candidates(const map::Snapshot&, const FeatureSet&, MapId map,
                                     KeyframeId near);
  std::optional<Relocation> try_keyframe(const map::Snapshot&, const FeatureSet&,
                                         KeyframeId candidate, int min_inliers);

  CandidateSource source_;
  std::uint32_t next_ = 0;
};

}  // namespace fastloop::tracking
