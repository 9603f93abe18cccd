#pragma once

#include <memory>
#include <optional>
#include <string>

#include "fastloop/compute/executor.hpp"
#include "fastloop/map/snapshot.hpp"

namespace fastloop::map {

/// The map, held by one owner (the mapping worker). Everyone else reads `publish()`ed snapshots.
///
/// Invariants, checked by `find_inconsistency`: observations and keyframe entries name each other;
/// covisibility counts equal shared landmarks; anchors observe their landmark; links lead to live
/// entities.
class Map : public Snapshot {
 public:
  Map(const StereoRig& rig, const PyramidScales& scales);
  /// A private copy to work on; shares everything that is not changed.
  explicit Map(const Snapshot& snapshot) : Snapshot(snapshot) {}

  /// Immutable copy of the present state.
  std::shared_ptr<const Snapshot> publish() const {
    return std::make_shared<const Snapshot>(*this);
  }

  MapId start_map();
  MapInfo& mutable_info(MapId id) { return maps_[id.value()]; }

  /// Appends a keyframe to a map; it becomes the temporal successor of the map's last keyframe.
  KeyframeId add_keyframe(MapId map, std::shared_ptr<const KeyframeData> data,
                          const NavState& state,
                          std::shared_ptr<const PreintegratedImu> imu_from_previous);
  /// Removes a keyframe that is not the first of its map: observations dissolve, children get new
  /// parents, IMU measurements of its two neighbours are joined.
  void remove_keyframe(KeyframeId id);

  /// New landmark anchored in and observed by `keyframe`; the keypoint must be free.
  LandmarkId add_landmark(KeyframeId keyframe, std::uint32_t keypoint, const Vector3d& p_world);
  void remove_landmark(LandmarkId id);
  /// False when the keypoint is taken or the keyframe sees the landmark already.
  bool add_observation(LandmarkId id, KeyframeId keyframe, std::uint32_t keypoint);
  /// Removes the landmark as well when fewer than `min_observers` keyframes would be left.
  void remove_observation(LandmarkId id, KeyframeId keyframe, int min_observers = 1);
  /// Moves all observations of `loser` to `winner` where they do not collide, then removes `loser`.
  void replace_landmark(LandmarkId loser, LandmarkId winner, bool published_refresh = false);

  struct FusionOutcome {
    std::size_t merged = 0, observed = 0;
    double landmarks_ms = 0, covisibility_ms = 0;  ///< the reference does not tell them apart
  };
  /// replace_landmark for every merge, then add_observation for every observation, in this order and
  /// following earlier replacements. Every landmark is refreshed once at the end, and covisibility
  /// changes in one go; the reference does it one by one, with the same result.
  FusionOutcome fuse_landmarks(const Executor& executor, std::span<const LandmarkMerge> merges,
                               std::span<const NewObservation> observations);

  void set_state(KeyframeId id, const NavState& state);
  /// The same for several, ascending, on all cores.
  void set_states(const Executor& executor,
                  std::span<const std::pair<KeyframeId, NavState>> states);
  void set_p_world(LandmarkId id, const Vector3d& p_world);
  void set_p_anchor(LandmarkId id, const Vector3d& p_anchor);
  /// To be called after a change that moved a large part of a map at once; see frame_version().
  void note_frame_change();
  /// Rotates and moves one whole map: T_new_old applied to poses, velocities.
  void transform_map(MapId map, const SE3& T_new_old);
  /// Makes one map of two whose keyframes lie in the same world frame already: the keyframes of
  /// `from` join `into`, in the order of their ids; measurements of the IMU between keyframes that
  /// are no longer neighbours in time are dropped. The younger of the two roots becomes a child of
  /// `link`, or, if that is not older, of its predecessor in time.
  void merge_maps(MapId from, MapId into, KeyframeId link);
  void add_loop_edge(const LoopEdge& edge);
  void set_imu(KeyframeId id, std::shared_ptr<const PreintegratedImu> imu);
  void set_parent(KeyframeId child, KeyframeId parent) {
    keyframes_.mutate(child.value()).parent = parent;
  }

  /// Representative descriptor (least median distance to the others), viewing direction, distance
  /// range.
  void refresh_landmark(LandmarkId id);
  void count_visible(LandmarkId id, std::uint32_t visible, std::uint32_t found);

  /// Chooses the best covisible keyframe as parent (the previous one when there is none).
  void attach_to_spanning_tree(KeyframeId id);

  /// First violated invariant, in words.
  std::optional<std::string> find_inconsistency() const;

 private:
  friend class LandmarkFusion;  // the working part of fuse_landmarks
  /// What a landmark looks like, from its observations.
  struct Appearance {
    Descriptor descriptor;
    Eigen::Vector3f normal_anchor;
    float max_distance_m = 0;
  };
  Appearance appearance_of(LandmarkId id, bool published) const;
  void set_appearance(LandmarkId id, const Appearance& appearance);
  FusionOutcome fuse_landmarks_reference(std::span<const LandmarkMerge> merges,
                                         std::span<const NewObservation> observations);
  void change_shared(KeyframeId a, KeyframeId b, int change);
  void relink_children(KeyframeId removed);
};

}  // namespace fastloop::map
