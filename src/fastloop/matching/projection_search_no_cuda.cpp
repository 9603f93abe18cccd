#include "fastloop/matching/projection_search_cuda.hpp"

namespace fastloop::matching {

bool search_on_device(CudaSession&, const ProjectionCall&, ProjectionFound&) { return false; }

}  // namespace fastloop::matching
