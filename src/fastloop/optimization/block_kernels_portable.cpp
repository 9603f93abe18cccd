#include "fastloop/optimization/block_kernels.hpp"

#define FASTLOOP_SIMD_LANES 2
#define FASTLOOP_TILE_COLUMNS 4
#define FASTLOOP_TILE_VECTORS 2

namespace fastloop::optimization::block {
namespace {
// Each file uses what the one before it defines.
// clang-format off
#include "fastloop/optimization/block_simd.inl"
#include "fastloop/optimization/block_edges.inl"
#include "fastloop/optimization/block_fronts.inl"
// clang-format on
}  // namespace

const KernelSet& portable_kernels() {
  static const KernelSet set = make_kernel_set("portable");
  return set;
}

}  // namespace fastloop::optimization::block
