#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <span>
#include <vector>

#include "fastloop/compute/executor.hpp"
#include "fastloop/features/feature_set.hpp"
#include "fastloop/geometry/se3.hpp"
#include "fastloop/matching/match_lists.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop::matching {

inline constexpr std::int32_t kNoMatch = -1;

class ResidentLandmarks;

/// Landmarks as flat arrays; every span has num_landmarks entries.
struct LandmarkView {
  std::span<const Eigen::Vector3f> p_world;  ///< metres
  /// Mean viewing direction, unit, from camera to landmark. May be empty when no option needs it.
  std::span<const Eigen::Vector3f> normal_world;
  std::span<const float> min_distance_m,
      max_distance_m;  ///< distances at which the scale pyramid still sees it
  std::span<const Descriptor> descriptor;
  /// The same landmarks on a device (make_resident), for a search there; may be null.
  const ResidentLandmarks* resident = nullptr;
  std::size_t size() const { return p_world.size(); }
};

/// One keyframe (or frame) to search in, with a pose hypothesis for it.
struct SearchTarget {
  const FeatureSet* features = nullptr;
  SE3 T_camera_world;
  double scale = 1;  ///< of a Sim3 hypothesis: p_camera = scale * (T_camera_world * p_world)
  std::span<const std::uint8_t>
      keypoint_blocked;  ///< [num_keypoints] non-zero = not to be matched; may be empty
  std::span<const std::uint8_t>
      landmark_skipped;  ///< [num_landmarks] non-zero = not to be searched; may be empty
};

/// The rule of one search. Defaults are those of loop detection (reference/loop-closing.md section
/// 5).
struct ProjectionSearchOptions {
  float radius_px = 3;        ///< times scale^level: half width of the square window, inclusive
  int max_distance = 75;      ///< Hamming, inclusive
  float min_view_cos = 0.5f;  ///< between landmark normal and viewing ray; -1 switches the gate off
  float min_distance_factor = 0.8f,
        max_distance_factor = 1.2f;          ///< of the landmark's distance range
  int octaves_below = 1, octaves_above = 0;  ///< accepted: [level - below, level + above]
  /// < 1: reject if best > ratio * second best and both have the same octave.
  float best_to_second = 1;
  float wide_view_cos = 2;  ///< below this viewing cosine the radius is multiplied by wide_factor
  float wide_factor = 1;
  bool check_right =
      false;  ///< keypoints with a right coordinate must lie in the window there, too
  float chi2_gate_mono =
      0;  ///< > 0: reprojection gate per keypoint octave (sigma^2), 2 degrees of freedom
  float chi2_gate_stereo =
      0;  ///< > 0: the same with the right coordinate, where the keypoint has one
};

/// Result for one target. Each landmark has at most one keypoint and each keypoint at most one
/// landmark: among the claims on a keypoint the smallest (distance, landmark index) wins; losers
/// stay unmatched.
struct ProjectionMatches {
  std::vector<std::int32_t> keypoint;   ///< [num_landmarks] keypoint index or kNoMatch
  std::vector<std::uint16_t> distance;  ///< [num_landmarks] Hamming distance of the match
  std::vector<std::uint8_t>
      in_view;    ///< [num_landmarks] passed all gates before the descriptor search
  int count = 0;  ///< matched landmarks
};

/// THE primitive: searches every landmark in every target.
///
/// For each (target, landmark): transform, depth gate, project, image bounds, distance range,
/// viewing angle, predicted level = ceil(log(max_distance / distance) / log(scale factor)) clamped
/// to the pyramid, grid window, best Hamming distance (ties: the lower keypoint index), then one
/// keypoint to one landmark by (distance, landmark index).
///
/// Deterministic for any executor and number of threads: all arithmetic before the descriptor
/// comparison is in float, in one order. Reentrant.
///
/// @param[out] results  [targets.size()]
/// @throws InvalidArgument on unequal extents or a target without features.
void search_by_projection(const Executor& executor, const StereoRig& rig,
                          const PyramidScales& scales, std::span<const SearchTarget> targets,
                          const LandmarkView& landmarks, const ProjectionSearchOptions& options,
                          std::span<ProjectionMatches> results);

/// Some landmarks and where to search them.
struct ProjectionJob {
  LandmarkView landmarks;
  std::span<const SearchTarget> targets;
};

/// search_by_projection for several sets of landmarks at once, by one rule: one launch on a device.
/// The same matches, without a word on the landmarks that have none.
/// @return the targets of all jobs, one after another
MatchLists find_by_projection(const Executor& executor, const StereoRig& rig,
                              const PyramidScales& scales, std::span<const ProjectionJob> jobs,
                              const ProjectionSearchOptions& options);

/// Starts copying to the executor's device what searches will read: features of keyframes, which
/// stay there (ResidentStore), and landmarks, which stay as long as the returned object, for
/// LandmarkView::resident. Neither may change from now on. Without a device nothing happens.
void make_resident(const Executor& executor, const std::shared_ptr<const FeatureSet>& features);
std::shared_ptr<const ResidentLandmarks> make_resident(const Executor& executor,
                                                       const LandmarkView& landmarks);

/// A keypoint search around given pixels: the search in the last frame. Each query carries its own
/// pixel, radius and octave range; resolution as above.
struct WindowQuery {
  Eigen::Vector2f pixel;
  float right_x;  ///< predicted right coordinate; NaN: no check of the right coordinate
  float radius_px;
  std::int16_t min_octave, max_octave;
  Descriptor descriptor;
  float angle_rad;  ///< orientation of the source keypoint, for the rotation histogram; NaN: not
                    ///< voting
};

struct WindowSearchOptions {
  int max_distance = 100;
  float best_to_second =
      1;  ///< < 1: reject if best > ratio * second best and both have the same octave
  bool check_rotation = true;  ///< 30-bin histogram of orientation change, the three best bins kept
};

/// A query with a right coordinate only takes keypoints whose right coordinate, where they have
/// one, lies within the radius of it.
///
/// @return [queries.size()] keypoint index or kNoMatch
/// @throws InvalidArgument when `keypoint_blocked` is neither empty nor [num_keypoints]
std::vector<std::int32_t> search_windows(const Executor& executor, const FeatureSet& features,
                                         std::span<const WindowQuery> queries,
                                         const WindowSearchOptions& options,
                                         std::span<const std::uint8_t> keypoint_blocked = {});

}  // namespace fastloop::matching
