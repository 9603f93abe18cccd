#include "fastloop/loop/similarity_ransac_cuda.hpp"

namespace fastloop::loop {

bool count_inliers_cuda(CudaSession&, const matching::CameraView&, std::uint64_t, bool,
                        std::span<HypothesisRange>) {
  return false;  // no session can be opened in this build
}

}  // namespace fastloop::loop
