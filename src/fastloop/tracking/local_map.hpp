#pragma once

#include <vector>

#include "fastloop/map/snapshot.hpp"
#include "fastloop/matching/projection_search.hpp"

namespace fastloop::tracking {

/// Landmarks around the camera: those of the keyframes that share landmarks with the frame, and of
/// their neighbours, as flat arrays for the projection search. Buffers are kept between frames.
class LocalMap {
 public:
  /// @param landmarks      matched landmarks of the frame (invalid entries allowed)
  /// @param recent         a keyframe whose temporal predecessors are included too; may be invalid
  void update(const map::Snapshot& snapshot, const std::vector<LandmarkId>& landmarks,
              KeyframeId recent, std::size_t max_keyframes);

  const std::vector<KeyframeId>& keyframes() const { return keyframes_; }
  /// Keyframe that shares most landmarks with the frame; invalid when none does.
  KeyframeId reference() const { return reference_; }

  const std::vector<LandmarkId>& ids() const { return ids_; }
  matching::LandmarkView view() const;

 private:
  void choose_keyframes(const map::Snapshot&, const std::vector<LandmarkId>&, KeyframeId recent,
                        std::size_t max);
  void gather(const map::Snapshot&);

  KeyframeId reference_;
  std::vector<KeyframeId> keyframes_;
  std::vector<std::uint32_t> votes_, keyframe_mark_, landmark_mark_;
  std::uint32_t mark_ = 0;
  std::vector<LandmarkId> ids_;
  std::vector<Eigen::Vector3f> p_world_, normal_;
  std::vector<float> min_distance_, max_distance_;
  std::vector<Descriptor> descriptor_;
};

}  // namespace fastloop::tracking
