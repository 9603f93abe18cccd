#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/geometry/sim3.hpp"
#include "fastloop/loop/similarity_math.hpp"
#include "fastloop/loop/step_executors.hpp"

namespace fastloop::loop {

/// Landmarks that are thought to be pairwise the same, on two sides: the first is one camera, the
/// second a world (its origin moved near, so that floats suffice) with cameras that saw it.
struct SimilarityPairs {
  std::vector<float> p_first;     ///< [3n] in the first camera, metres
  std::vector<float> pixel_first; ///< [2n]
  std::vector<float> gate_first;  ///< [n] largest squared pixel error
  std::vector<float> p_second;    ///< [3n]
  std::vector<std::int32_t> view; ///< [n] camera of the second side that saw it
  std::vector<float> pixel_view;  ///< [2n]
  std::vector<float> gate_view;   ///< [n]
  std::vector<ViewPose> views;

  std::size_t size() const { return gate_first.size(); }
};

struct RansacOptions {
  int max_hypotheses = 300;
  int chunk = 20;           ///< hypotheses between two looks at the result
  int min_inliers = 15;     ///< more than this many accept
  double confidence = 0.99;
  std::uint64_t seed = 1;
  bool fixed_scale = true;
};

struct RansacResult {
  bool found = false;
  Sim3 S_first_second;
  int hypothesis = -1;  ///< index of the one chosen
  int num_inliers = 0;  ///< of the best one, accepted or not
  int evaluated = 0;    ///< hypotheses up to the end of the chunk that decided
  std::vector<std::uint8_t> inlier;  ///< [pairs]; empty unless found
};

/// Similarity between the sides of each problem by random samples of three pairs. A pair is an
/// inlier when its reprojection errors both ways are within their gates. The first chunk that holds
/// a hypothesis with more than min_inliers ends the search; the best of that chunk is taken (ties:
/// the lowest index). The hypotheses of a chunk of all undecided problems are evaluated together, on
/// the device all hypotheses of all problems at once; the result is the same for any executor.
///
/// @param[out] results  [problems.size()]
void find_similarities(const StepExecutors& executors, const matching::CameraView& camera,
                       std::span<const SimilarityPairs> problems, const RansacOptions& options,
                       std::span<RansacResult> results);

}  // namespace fastloop::loop
