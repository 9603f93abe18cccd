#pragma once

#include <span>
#include <utility>

#include "fastloop/map/cow_vector.hpp"
#include "fastloop/map/entities.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop::map {

/// A version of the map for reading. Immutable once published; safe to read from any thread.
class Snapshot {
 public:
  std::uint64_t version() const { return version_; }
  /// Changes whenever a pose, velocity or bias that existed before was changed.
  std::uint64_t pose_version() const { return pose_version_; }

  /// Changes whenever the world frame of a map, or a large part of a map in it, moved at once:
  /// alignment to gravity, loop correction, merging.
  std::uint64_t frame_version() const { return frame_version_; }

  const StereoRig& rig() const { return rig_; }
  const PyramidScales& scales() const { return scales_; }

  std::size_t keyframe_slots() const { return keyframes_.size(); }  ///< live and removed
  std::size_t landmark_slots() const { return landmarks_.size(); }
  std::size_t num_keyframes() const { return num_keyframes_; }  ///< live
  std::size_t num_landmarks() const { return num_landmarks_; }

  bool contains(KeyframeId id) const {
    return id.value() < keyframes_.size() && !keyframes_[id.value()].removed;
  }
  bool contains(LandmarkId id) const {
    return id.value() < landmarks_.size() && !landmarks_[id.value()].removed();
  }
  const Keyframe& keyframe(KeyframeId id) const { return keyframes_[id.value()]; }
  const Landmark& landmark(LandmarkId id) const { return landmarks_[id.value()]; }

  /// Follows replacements to the landmark that stands for `id` today; invalid when it was removed.
  LandmarkId resolve(LandmarkId id) const;
  /// Pose of a keyframe, live or removed.
  SE3 T_world_body(KeyframeId id) const;
  SE3 T_world_camera(KeyframeId id) const { return T_world_body(id) * rig_.T_body_left; }
  Vector3d p_world(LandmarkId id) const {
    const Landmark& l = landmark(id);
    return keyframe(l.anchor).state.T_world_body * l.p_anchor;
  }
  Vector3d normal_world(LandmarkId id) const {
    const Landmark& l = landmark(id);
    return keyframe(l.anchor).state.T_world_body.rotation * l.normal_anchor.cast<double>();
  }
  PixelObservation pixel(KeyframeId keyframe, std::uint32_t keypoint) const;

  /// All neighbours that share a landmark, ordered by id.
  const std::vector<CovisibilityEdge>& covisible(KeyframeId id) const {
    return covisibility_[id.value()];
  }
  /// Landmarks that two keyframes share.
  int num_shared(KeyframeId a, KeyframeId b) const;
  /// The `count` neighbours with most shared landmarks, at least `min_shared`; ties: lower id
  /// first.
  std::vector<KeyframeId> best_covisible(KeyframeId id, std::size_t count,
                                         int min_shared = 1) const;
  /// Landmarks of a keyframe that are seen by at least `min_observers` keyframes.
  int count_tracked(KeyframeId id, int min_observers) const;

  /// Loops closed so far, in the order they were closed. Ends may have been removed since.
  const std::vector<LoopEdge>& loop_edges() const { return loop_edges_; }
  const std::vector<MapInfo>& maps() const { return maps_; }
  /// The map that stands for `id` today: itself, or the one it was merged into.
  MapId resolve(MapId id) const;
  const MapInfo& map_info(MapId id) const { return maps_[id.value()]; }

 protected:
  friend class Map;
  friend class MapFileAccess;  // fills a map from a file
  using Keyframes = CowVector<Keyframe, 8>;
  using Landmarks = CowVector<Landmark, 64>;
  using Covisibility = CowVector<std::vector<CovisibilityEdge>, 8>;

  std::uint64_t version_ = 0, pose_version_ = 0, frame_version_ = 0;
  StereoRig rig_;
  PyramidScales scales_;
  Keyframes keyframes_;
  Landmarks landmarks_;
  Covisibility covisibility_;
  std::vector<MapInfo> maps_;
  std::vector<LoopEdge> loop_edges_;
  std::size_t num_keyframes_ = 0, num_landmarks_ = 0;
};

}  // namespace fastloop::map
