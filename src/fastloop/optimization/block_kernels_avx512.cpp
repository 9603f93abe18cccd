#include "fastloop/optimization/block_kernels.hpp"

#if defined(__x86_64__)  // compiled with the flags of this instruction set, see CMakeLists.txt

#define FASTLOOP_SIMD_LANES 8
#define FASTLOOP_TILE_COLUMNS 8
#define FASTLOOP_TILE_VECTORS 3

namespace fastloop::optimization::block {
namespace {
// Each file uses what the one before it defines.
// clang-format off
#include "fastloop/optimization/block_simd.inl"
#include "fastloop/optimization/block_edges.inl"
#include "fastloop/optimization/block_fronts.inl"
// clang-format on
}  // namespace

const KernelSet& avx512_kernels() {
  static const KernelSet set = make_kernel_set("avx512");
  return set;
}

}  // namespace fastloop::optimization::block

#endif
