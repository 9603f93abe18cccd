#pragma once

#include <cstddef>

namespace fastloop::loop {

/// Thresholds of loop closing. Names in brackets are those of the FastLoop paper; values without
/// remark are the published ones.
struct LoopOptions {
  bool close_loops = true;
  bool merge_maps = true;
  bool inertial = false;  ///< gravity is known: corrections turn about the vertical only

  // When a keyframe is looked at.
  std::size_t min_keyframes = 12;           ///< of its map
  std::size_t candidates = 3;               ///< of loops, and as many of merges
  float min_shared_ratio = 0.6f;            ///< of the words; published: 0.8, without ranking
  int ranked_candidates = 20;               ///< put in order of descriptor matches before the first few are verified

  // Verification of a candidate.
  std::size_t window_covisibles = 10;
  int max_match_distance = 49;              ///< Hamming, inclusive
  float match_ratio = 0.9f;
  int min_matches = 20;                     ///< landmarks matched by descriptor
  int min_ransac_inliers = 15;              ///< exclusive
  double ransac_gate_chi2 = 9.21;
  float wide_radius_px = 8;                 ///< [PS2a]
  int wide_max_distance = 75;
  int min_wide_matches = 50;
  int min_refined_inliers = 20;
  float narrow_radius_px = 5;               ///< [PS2b]
  int narrow_max_distance = 50;
  int min_narrow_matches = 80;
  float covisible_radius_px = 3;            ///< [PS3a-c] and the re-check [PS1]
  int covisible_max_distance = 75;
  int min_covisible_matches = 30;
  int confirmations = 3;                    ///< covisible or later keyframes that must agree

  // Re-check of a waiting candidate.
  int min_recheck_inliers = 50;             ///< exclusive
  int min_recheck_matches = 100;
  int max_misses = 2;

  // Gates on the correction.
  double max_tilt_rad = 0.008;              ///< inertial: roll and pitch that a loop may demand
  double max_yaw_rad = 0.349;
  /// A loop may demand a correction of this part of the path travelled since the place was seen,
  /// plus a constant: odometry drifts by far less, and a larger demand means that two places look
  /// alike. Not published. 0 switches the gate off.
  double max_drift_ratio = 0.03;
  double max_drift_constant_m = 0.5;
  double max_drift_rad_per_m = 0.01, max_drift_constant_rad = 0.15;
  /// Two verified candidates of one keyframe that disagree by more than this make it ambiguous.
  double ambiguous_distance_m = 1, ambiguous_angle_rad = 0.2;

  // Fusion and graph.
  float fusion_radius_px = 4;
  int fusion_max_distance = 50;
  int min_connection = 15;                  ///< shared landmarks that connect two keyframes
  int graph_min_connection = 100;           ///< that make an edge of the essential graph
  int graph_threads = 1;

  void validate() const;  ///< throws InvalidArgument naming the field
};

}  // namespace fastloop::loop
