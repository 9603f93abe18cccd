#pragma once

#include <memory>
#include <vector>

#include "fastloop/core/ids.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/features/feature_set.hpp"
#include "fastloop/map/cow_pointer.hpp"
#include "fastloop/sensor/imu.hpp"

namespace fastloop::map {

/// What a keyframe saw; never changes and is shared by all snapshots.
struct KeyframeData {
  FrameId frame;
  Nanoseconds stamp_ns = 0;
  std::shared_ptr<const FeatureSet> features;
};

/// The landmark that each keypoint of a keyframe shows; invalid: none. Copies share the list until
/// one is written to, so that moving a keyframe does not copy a thousand ids.
class KeypointLandmarks {
 public:
  KeypointLandmarks() = default;
  explicit KeypointLandmarks(std::vector<LandmarkId> ids) : ids_(std::move(ids)) {}

  const std::vector<LandmarkId>& ids() const { return *ids_; }
  operator const std::vector<LandmarkId>&() const { return *ids_; }
  std::size_t size() const { return ids_->size(); }
  bool empty() const { return ids_->empty(); }
  LandmarkId operator[](std::size_t keypoint) const { return (*ids_)[keypoint]; }
  auto begin() const { return ids_->begin(); }
  auto end() const { return ids_->end(); }

  bool operator==(const KeypointLandmarks& o) const { return *ids_ == *o.ids_; }

  void set(std::size_t keypoint, LandmarkId id) { ids_.mutate()[keypoint] = id; }
  /// Copies the list now if others share it.
  void unshare() { ids_.mutate(); }

 private:
  CowPointer<std::vector<LandmarkId>> ids_;
};

/// A keyframe as the map knows it. A removed keyframe keeps its place in the list (ids are indices)
/// and its pose relative to a live one, so that trajectories through it stay defined.
struct Keyframe {
  std::shared_ptr<const KeyframeData> data;
  MapId map;
  NavState state;                     ///< T_world_body, velocity, bias
  KeypointLandmarks landmarks;        ///< [num_keypoints]; emptied on removal
  KeyframeId parent;                  ///< spanning tree; invalid at the root of a map
  KeyframeId previous, next;          ///< temporal neighbours among live keyframes of the map
  std::shared_ptr<const PreintegratedImu> imu_from_previous;  ///< null without IMU or at a gap
  bool removed = false;
  KeyframeId anchor_of_removed;  ///< with `removed`: pose = anchor pose * T_anchor_body
  SE3 T_anchor_body;
};

struct Observation {
  KeyframeId keyframe;
  std::uint32_t keypoint = 0;
};

/// A landmark lives in the body frame of its anchor keyframe: moving the keyframe moves the
/// landmark.
struct Landmark {
  KeyframeId anchor;                     ///< an observing keyframe; invalid when removed
  LandmarkId replaced_by;                ///< valid when it was merged into another one
  Vector3d p_anchor = Vector3d::Zero();  ///< metres, anchor's body frame
  Eigen::Vector3f normal_anchor =
      Eigen::Vector3f::Zero();  ///< mean viewing direction, from camera to landmark
  float min_distance_m = 0, max_distance_m = 0;  ///< at which the scale pyramid sees it
  Descriptor descriptor;
  std::vector<Observation> observations;  ///< ordered by keyframe id, at most one per keyframe
  KeyframeId first_keyframe;              ///< that created it
  std::uint32_t visible = 1, found = 1;   ///< frames it was predicted in / found in

  bool removed() const { return !anchor.valid(); }
};

/// Two landmarks that show the same point: the loser's observations become the winner's.
struct LandmarkMerge {
  LandmarkId loser, winner;
};

struct NewObservation {
  LandmarkId landmark;
  KeyframeId keyframe;
  std::uint32_t keypoint = 0;
};

/// Number of landmarks shared with another keyframe.
struct CovisibilityEdge {
  KeyframeId keyframe;
  int shared = 0;
};

/// A loop that was closed: two keyframes whose relative pose was measured by place recognition.
struct LoopEdge {
  KeyframeId a, b;
  SE3 T_a_b;  ///< body of b in the body frame of a
};

/// One connected map; several exist after tracking was lost for good.
struct MapInfo {
  MapId id;
  KeyframeId first_keyframe, last_keyframe;
  bool imu_initialized = false;
  int imu_refinements = 0;        ///< later inertial adjustments: 0, 1 (5 s), 2 (15 s)
  std::size_t num_keyframes = 0;  ///< live
  MapId merged_into;  ///< valid when the map was welded to another one and is empty since
};

}  // namespace fastloop::map
