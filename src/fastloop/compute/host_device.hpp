#pragma once

/// FASTLOOP_HD marks the functions of a functor that runs on the host and, compiled by nvcc, on the
/// device. Such code uses plain pointers and float arithmetic of IEEE operations only (no library
/// transcendentals), so that both give the same bits.
#if defined(__CUDACC__)
#define FASTLOOP_HD __host__ __device__
#else
#define FASTLOOP_HD
#endif
