#pragma once

#include "fastloop/features/feature_set.hpp"
#include "fastloop/features/orb_extractor.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop {

/// Features of one camera with the pyramid they came from.
struct StereoView {
  const OrbFeatures& features;
  const ImagePyramid& pyramid;
};

struct StereoMatchOptions {
  int max_distance = 75;            ///< Hamming, below which descriptors may match
  float row_tolerance_px = 2;       ///< distance from the row or epipolar line, times the scale
  int search_px = 5;                ///< refinement: range about the matched keypoint, level pixels
  float min_correlation = 0.85f;     ///< of the refined patches
  float min_disparity_px = 0.1f;    ///< rectified: less is as good as infinitely far
  float best_to_second = 0.8f;      ///< fisheye: ratio of the best distance to the second best
  float min_parallax_rad = 0.005f;  ///< fisheye
  float max_parallax_rad = 0.7f;    ///< fisheye
};

/// Fills `right_x`, `right_y` and `depth_m` of the frame: from features of rectified images,
/// candidates by row. The other arrays of `frame` are those of `left`. Runs on oneTBB; independent
/// of the number of threads.
void match_rectified(const StereoRig& rig, const PyramidScales& scales, const StereoView& left,
                     const StereoView& right, const StereoMatchOptions& options, FeatureSet& frame);

/// The same for two cameras of any kind with overlapping views. Every plane through both camera
/// centres cuts each view in an epipolar curve; the angle of that plane about the baseline takes
/// the place of the row, the angle from the baseline that of the column.
void match_general(const StereoRig& rig, const PyramidScales& scales, const StereoView& left,
                   const StereoView& right, const StereoMatchOptions& options, FeatureSet& frame);

}  // namespace fastloop
