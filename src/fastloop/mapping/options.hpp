#pragma once

#include <cstddef>

namespace fastloop::mapping {

struct MappingOptions {
  bool use_imu = false;
  double close_depth_baselines = 40;  ///< stereo points up to this depth become landmarks at once
  std::size_t min_stereo_landmarks =
      100;  ///< the closest points are taken beyond that depth up to this number
  std::size_t triangulation_neighbours = 8;
  std::size_t fusion_neighbours = 10;
  std::size_t window_keyframes = 12;  ///< local adjustment, visual: free keyframes
  std::size_t window_keyframes_inertial = 10;
  std::size_t fixed_keyframes = 20;  ///< local adjustment: keyframes held fixed
  std::size_t max_window_points = 4000;
  int adjustment_iterations = 5;
  int adjustment_iterations_after_gate = 4;
  int threads = 1;
  double redundant_share = 0.9;  ///< culling: share of landmarks seen by three others
  double redundant_share_inertial = 0.6;
  double max_imu_gap_s = 3;    ///< culling never leaves a longer gap between neighbours
  int imu_min_keyframes = 10;  ///< initialisation
  double imu_min_seconds = 2;
  double imu_refine_first_s = 5, imu_refine_second_s = 13;
  void validate() const;  ///< throws InvalidArgument naming the field
};

}  // namespace fastloop::mapping
