#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/loop/similarity_math.hpp"

namespace fastloop {
class CudaSession;
}

namespace fastloop::loop {

/// Hypotheses [begin, end) of one problem and their inliers.
struct HypothesisRange {
  PairArrays pairs;  ///< on the host; at least three
  int begin = 0, end = 0;
  std::vector<int> counts;  ///< [end - begin] written
};

/// Counts the inliers of all hypotheses of all problems in one launch, with one copy there and one
/// back. The counts are those of the CPU: the same arithmetic, IEEE operation by IEEE operation.
/// @return false when the device failed, which the session reports; no count is valid then
bool count_inliers_cuda(CudaSession& session, const matching::CameraView& camera,
                        std::uint64_t seed, bool fixed_scale, std::span<HypothesisRange> ranges);

}  // namespace fastloop::loop
