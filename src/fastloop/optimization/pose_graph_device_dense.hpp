#pragma once

#include <cmath>
#include <cstdint>

#include "fastloop/optimization/pose_graph_device_product.hpp"

/// Dense kernels of a team of threads: a block of the device, or the one thread of the host's
/// executor. A team has rank(), size(), sync(), and within it warps with lane(), lanes(), warp(),
/// warps(), sum().
namespace fastloop::optimization::device {

/// Lower triangle in column groups of eight, each only as tall as it must be: half of the memory of
/// a square matrix, so that a front twice as large fits.
struct Trapezoid {
  double* data;
  int rows;  ///< even

  FASTLOOP_HD static long long doubles(int rows, int columns) {
    const long long groups = (columns + kPanel - 1) / kPanel;
    return kPanel * groups * rows - 4 * kPanel * groups * (groups - 1);
  }
  /// Pointer p with p[r] = entry (r, c).
  FASTLOOP_HD double* column(int c) const {
    const int g = c / kPanel;
    return data + kPanel * g * rows - 4 * kPanel * g * (g - 1) +
           (c % kPanel) * (rows - kPanel * g) - kPanel * g;
  }
  /// Doubles between two columns of the group of c.
  FASTLOOP_HD int stride(int c) const { return rows - c / kPanel * kPanel; }
};

/// Square matrix, the same interface.
struct Square {
  double* data;
  int rows;
  FASTLOOP_HD double* column(int c) const { return data + c * rows; }
  FASTLOOP_HD int stride(int) const { return rows; }
};

struct Triangle {
  double l[kPanel][kPanel];
};

/// 1 / sqrt(x) for x > 0. On the device: the unit's approximation and one step of third order, a
/// third of the latency of the library's, and it lies on the longest way through every front.
FASTLOOP_HD inline double inverse_root(double x) {
#if defined(__CUDA_ARCH__)
  double y;
  asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(y) : "d"(x));
  const double e = fma(-x * y, y, 1.0);
  return fma(y * e, fma(0.375, e, 0.5), y);
#else
  return 1.0 / sqrt(x);
#endif
}

/// Cholesky of a triangle in registers, with inverted diagonal; columns beyond its width are those
/// of the identity. Two pivots at a time: the root of the second needs the determinant of both
/// only, so that both are on their way at once. False: not positive definite.
FASTLOOP_HD inline bool factor_triangle(Triangle& t) {
  bool ok = true;
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; c += 2) {
    const double p = t.l[c][c], q = t.l[c + 1][c];
    const double determinant = p * t.l[c + 1][c + 1] - q * q;
    ok = ok && p > 1e-300 && p < 1e300 && determinant > 1e-300 && determinant < 1e300;
    const double first = inverse_root(p), root = inverse_root(determinant);
    const double below = q * first, second = p * first * root, back = -below * second;
    t.l[c][c] = first;
    t.l[c + 1][c] = below;
    t.l[c + 1][c + 1] = second;
    FASTLOOP_UNROLL
    for (int r = c + 2; r < kPanel; ++r) {
      const double x = t.l[r][c] * first;
      t.l[r][c + 1] = t.l[r][c + 1] * second + x * back;
      t.l[r][c] = x;
    }
    FASTLOOP_UNROLL
    for (int o = c + 2; o < kPanel; ++o) {
      FASTLOOP_UNROLL
      for (int r = o; r < kPanel; ++r)
        t.l[r][o] = (t.l[r][o] - t.l[r][c] * t.l[o][c]) - t.l[r][c + 1] * t.l[o][c + 1];
    }
  }
  return ok;
}

/// The triangle of the block of `width` columns at `first`.
template <class Matrix>
FASTLOOP_HD inline void load_block(const Matrix& a, int first, int width, Triangle& t) {
  const double* column = a.column(first) + first;
  const int stride = a.stride(first);
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c) {
    FASTLOOP_UNROLL
    for (int r = c; r < kPanel; ++r) t.l[r][c] = r < width ? column[c * stride + r] : r == c;
  }
}

/// One warp: subtracts columns [from, first) of the rows of a block on the diagonal and factors it
/// in place.
template <class Team, class Matrix>
FASTLOOP_HD inline bool factor_block(const Team& team, const Matrix& a, int from, int first,
                                     int width) {
  double* block = a.column(first) + first;
  const int stride = a.stride(first);
  if (from < first) {
    const double* left = a.column(from) + first;
    const int left_stride = a.stride(from);  // one group of columns
    for (int k = team.lane(); k < kPanel * kPanel; k += team.lanes()) {
      const int r = k % kPanel, c = k / kPanel;
      if (r < c || r >= width) continue;
      double sum = 0;
      FASTLOOP_UNROLL
      for (int i = 0; i < kPanel; ++i) sum += left[i * left_stride + r] * left[i * left_stride + c];
      block[c * stride + r] -= sum;
    }
    team.sync_warp();
  }
  Triangle t;
  load_block(a, first, width, t);
  const bool ok = factor_triangle(t);
  team.sync_warp();
  if (team.lane() == 0) {
    FASTLOOP_UNROLL
    for (int c = 0; c < kPanel; ++c) {
      FASTLOOP_UNROLL
      for (int r = c; r < kPanel; ++r)
        if (r < width) block[c * stride + r] = t.l[r][c];
    }
  }
  return ok;
}

/// Row r of the panel: x <- x L^-T.
template <class Matrix>
FASTLOOP_HD inline void solve_row(const Matrix& a, int first, int width, int r, const Triangle& t) {
  double* column = a.column(first) + r;
  const int stride = a.stride(first);
  double x[kPanel];
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c) x[c] = c < width ? column[c * stride] : 0.0;
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c) {
    x[c] *= t.l[c][c];
    FASTLOOP_UNROLL
    for (int o = c + 1; o < kPanel; ++o) x[o] -= x[c] * t.l[o][c];
  }
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c)
    if (c < width) column[c * stride] = x[c];
}

/// Eliminates columns [0, pivots) of `a` (rows [0, rows), even stride), right-looking over the
/// pivot columns only. While the other warps update what lies to the right of a panel, the first
/// one updates and factors the next block on the diagonal. False, for rank 0: not positive
/// definite; then `a` holds nothing of use.
template <class Team, class Matrix>
FASTLOOP_HD inline bool factor_columns(const Team& team, const Matrix& a, int pivots, int rows) {
  const auto width_at = [&](int j) { return pivots - j < kPanel ? pivots - j : kPanel; };
  bool ok = true;
  if (team.warp() == 0) ok = factor_block(team, a, 0, 0, width_at(0));
  team.sync();
  for (int j = 0; j < pivots; j += kPanel) {
    const int width = width_at(j), below = j + width;
    if (below + team.rank() < rows) {
      Triangle t;
      load_block(a, j, width, t);
      for (int r = below + team.rank(); r < rows; r += team.size()) solve_row(a, j, width, r, t);
    }
    team.sync();
    if (below >= pivots) break;
    const int next = below + width_at(below);
    if (team.warp() == 0) ok = factor_block(team, a, j, below, next - below) && ok;
    for_lane_tiles(team, below, pivots, rows, team.warps() > 1, [&](const LaneTile& tile) {
      // All entries are read before any is written: the compiler may not reorder them itself.
      double acc[4][4];
      double* column[4];
      int top[4];
      FASTLOOP_UNROLL
      for (int c = 0; c < 4; ++c) {
        const int at = tile.column[c];
        column[c] = a.column(at < pivots ? at : below);
        top[c] = at < next ? next : at < pivots ? at : rows;
        FASTLOOP_UNROLL
        for (int r = 0; r < 4; ++r)
          acc[c][r] = tile.row[r] >= top[c] && tile.row[r] < rows ? -column[c][tile.row[r]] : 0.0;
      }
      multiply_tile(a, rows, a, rows, j, below, tile, acc);
      FASTLOOP_UNROLL
      for (int c = 0; c < 4; ++c) {
        FASTLOOP_UNROLL
        for (int r = 0; r < 4; ++r)
          if (tile.row[r] >= top[c] && tile.row[r] < rows) column[c][tile.row[r]] = -acc[c][r];
      }
    });
    team.sync();
  }
  return ok;
}

}  // namespace fastloop::optimization::device
