#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/compute/executor.hpp"
#include "fastloop/features/feature_set.hpp"
#include "fastloop/matching/bag_of_words.hpp"
#include "fastloop/matching/projection_search.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop::matching {

/// One of the two images whose keypoints are matched.
struct MatchSide {
  const FeatureSet* features = nullptr;
  const FeatureGroups* groups = nullptr;  ///< null on either side: all keypoints are compared
  std::span<const std::uint8_t>
      keypoint_blocked;  ///< [num_keypoints] non-zero = left out; may be empty
};

struct DescriptorMatchOptions {
  int max_distance = 50;  ///< Hamming, inclusive
  float best_to_second =
      0.9f;  ///< < 1: accepted if best < ratio * second best, or there is no second
  bool check_rotation = true;  ///< 30-bin histogram of orientation change, the three best bins kept
};

/// Matches two images by descriptor, within the groups of a vocabulary or, without groups, all
/// against all.
///
/// Every keypoint of `first` takes its nearest keypoint of `second` (ties: the lower index); of
/// several claims on one keypoint the smallest (distance, index in `first`) wins. Deterministic for
/// any executor.
///
/// @return [keypoints of first] index in `second` or kNoMatch
/// @throws InvalidArgument on missing features, unequal extents or indices out of range
std::vector<std::int32_t> match_descriptors(const Executor& executor, const MatchSide& first,
                                            const MatchSide& second,
                                            const DescriptorMatchOptions& options = {});

/// The same for one image and several others at once: one launch on a device.
/// @return [seconds]
std::vector<std::vector<std::int32_t>> match_descriptors(const Executor& executor,
                                                         const MatchSide& first,
                                                         std::span<const MatchSide> seconds,
                                                         const DescriptorMatchOptions& options = {});

/// Viewing rays of the keypoints of an image, in the camera frame.
struct Bearings {
  std::vector<Eigen::Vector3f> ray;                       ///< unit
  std::vector<Eigen::Matrix<float, 3, 2>> d_ray_d_pixel;  ///< how the ray turns with the pixel
};

/// Rays of the keypoints in the left camera of a rig; worth keeping with a keyframe.
Bearings compute_bearings(const Camera& camera, const FeatureSet& features);

struct TriangulationSide {
  MatchSide side;  ///< blocked: keypoints that have a landmark already
  SE3 T_camera_world;
  const Bearings* bearings = nullptr;  ///< of the features; null: computed on the fly
};

struct TriangulationMatchOptions {
  int max_distance = 50;  ///< Hamming, inclusive
  float epipolar_chi2 =
      3.84f;                  ///< of the squared pixel distance to the epipolar curve over sigma^2
  float min_epipole_px = 10;  ///< times sqrt(scale) of the octave; pairs without depth only
  bool check_rotation = false;
};

struct IndexPair {
  std::int32_t first, second;
  bool operator==(const IndexPair&) const = default;
};

/// Pairs of keypoints that may show the same, yet unmapped point: nearest descriptors among those
/// that meet the epipolar constraint of the two poses, one to one as in match_descriptors.
///
/// The constraint is written for viewing rays: the distance of the second ray from the epipolar
/// plane, turned into pixels by the first-order change of the ray; so it holds for every camera
/// model. Where neither keypoint has depth, those near the epipole are left out, for they give no
/// depth.
///
/// @return pairs in ascending order of `first`; none when the cameras share one centre
std::vector<IndexPair> search_for_triangulation(const Executor& executor, const StereoRig& rig,
                                                const PyramidScales& scales,
                                                const TriangulationSide& first,
                                                const TriangulationSide& second,
                                                const TriangulationMatchOptions& options = {});

}  // namespace fastloop::matching
