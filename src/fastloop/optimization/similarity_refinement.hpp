#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/compute/executor.hpp"
#include "fastloop/geometry/camera.hpp"
#include "fastloop/geometry/sim3.hpp"

namespace fastloop::optimization {

/// One landmark that two maps (or two ends of a loop) know: its place and its pixel on either side.
struct SimilarityPair {
  Vector3d p_first = Vector3d::Zero();                    ///< in the first camera's frame, metres
  Vector3d p_second = Vector3d::Zero();                   ///< in the second side's frame (a world)
  Eigen::Vector2d pixel_first = Eigen::Vector2d::Zero();  ///< in the first camera
  double inv_sigma2_first = 1;                            ///< 1 / pixels^2
  SE3 T_view_second;  ///< camera on the second side that saw the landmark
  Eigen::Vector2d pixel_view = Eigen::Vector2d::Zero();
  double inv_sigma2_view = 1;
};

struct SimilarityOptions {
  double chi2_gate = 10;  ///< of either squared, normalised reprojection error
  bool fixed_scale = true;
  int iterations = 5, iterations_after_gate = 10;  ///< the latter when the gate dropped pairs
  int min_pairs = 10;  ///< fewer left after the gate: no result
};

struct SimilarityResult {
  Sim3 S_first_second;
  std::vector<std::uint8_t> inlier;  ///< [pairs]
  int num_inliers = 0;               ///< 0: failed
};

/// The similarity between two sides of a loop from reprojection errors both ways: each landmark of
/// the second side into the first camera and each of the first side into the camera that saw its
/// partner. Levenberg-Marquardt on 7 (6 with fixed scale) unknowns with analytic derivatives and
/// Huber kernel; pairs beyond the gate are dropped, then it is repeated without kernel.
/// Deterministic, reentrant. Points behind a camera count as outliers.
/// @param executor  passes take some microseconds each; the result does not depend on it
SimilarityResult refine_similarity(const Camera& camera, const Sim3& initial_S_first_second,
                                   std::span<const SimilarityPair> pairs,
                                   const SimilarityOptions& options = {},
                                   const Executor& executor = Executor::reference());

/// The same as published: derivatives by central differences. Its oracle and its baseline.
SimilarityResult refine_similarity_reference(const Camera& camera,
                                             const Sim3& initial_S_first_second,
                                             std::span<const SimilarityPair> pairs,
                                             const SimilarityOptions& options = {});

}  // namespace fastloop::optimization
