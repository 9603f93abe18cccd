#pragma once

#include <cmath>
#include <cstdint>

#include "fastloop/optimization/pose_graph_device_math.hpp"
#include "fastloop/optimization/pose_graph_device_types.hpp"

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

/// Cholesky of the block of `width` columns at `first`, kept in registers, with inverted diagonal;
/// columns beyond the width are those of the identity. False: not positive definite.
template <class Matrix>
FASTLOOP_HD inline bool factor_diagonal(const Matrix& a, int first, int width, Triangle& t) {
  const double* column = a.column(first) + first;
  const int stride = a.stride(first);
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c) {
    FASTLOOP_UNROLL
    for (int r = c; r < kPanel; ++r) t.l[r][c] = r < width ? column[c * stride + r] : r == c;
  }
  bool ok = true;
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c) {
    const double pivot = t.l[c][c];
    ok = ok && pivot > 1e-300 && pivot < 1e300;
    const double inverse = inverse_root(pivot);
    t.l[c][c] = inverse;
    FASTLOOP_UNROLL
    for (int r = c + 1; r < kPanel; ++r) t.l[r][c] *= inverse;
    FASTLOOP_UNROLL
    for (int o = c + 1; o < kPanel; ++o) {
      FASTLOOP_UNROLL
      for (int r = o; r < kPanel; ++r) t.l[r][o] -= t.l[r][c] * t.l[o][c];
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

/// The 4 x 4 entries that a lane computes of a unit of 32 rows and 16 columns; pairs of rows lie
/// next to each other, so that they are loaded together and lanes meet no bank conflict.
struct LaneTile {
  int row[4], column[4];
  FASTLOOP_HD LaneTile(int lane, int row0, int column0) {
    const int x = lane % 8, y = lane / 8;
    for (int k = 0; k < 4; ++k) {
      row[k] = row0 + 2 * x + (k & 1) + 16 * (k / 2);
      column[k] = column0 + 2 * y + (k & 1) + 8 * (k / 2);
    }
  }
};

FASTLOOP_HD inline void load_pair(const double* p, double& a, double& b) {
#if defined(__CUDA_ARCH__)
  const double2 v = *reinterpret_cast<const double2*>(p);
  a = v.x;
  b = v.y;
#else
  a = p[0];
  b = p[1];
#endif
}

/// acc = sum over columns [begin, end) of (rows of the tile in `x`) x (columns of the tile as rows
/// of `y`). Rows of `x` end at x_rows, those of `y` at y_rows.
template <class Matrix>
FASTLOOP_HD inline void multiply_tile(const Matrix& x, int x_rows, const Matrix& y, int y_rows,
                                      int begin, int end, const LaneTile& tile,
                                      double (&acc)[4][4]) {
  // Rows beyond the end are read at the last pair of rows; their products are dropped.
  const int last_x = (x_rows - 1) / 2 * 2, last_y = (y_rows - 1) / 2 * 2;
  const int r0 = tile.row[0] < last_x ? tile.row[0] : last_x;
  const int r1 = tile.row[2] < last_x ? tile.row[2] : last_x;
  const int c0 = tile.column[0] < last_y ? tile.column[0] : last_y;
  const int c1 = tile.column[2] < last_y ? tile.column[2] : last_y;
  for (int group = begin; group < end;) {
    const int next = (group / kPanel + 1) * kPanel, stop = next < end ? next : end;
    const double *row = x.column(group), *column = y.column(group);
    const int x_stride = x.stride(group), y_stride = y.stride(group);
    FASTLOOP_UNROLL
    for (int k = group; k < stop; ++k, row += x_stride, column += y_stride) {
      double a[4], b[4];
      load_pair(row + r0, a[0], a[1]);
      load_pair(row + r1, a[2], a[3]);
      load_pair(column + c0, b[0], b[1]);
      load_pair(column + c1, b[2], b[3]);
      FASTLOOP_UNROLL
      for (int c = 0; c < 4; ++c) {
        FASTLOOP_UNROLL
        for (int r = 0; r < 4; ++r) acc[c][r] += a[r] * b[c];
      }
    }
    group = stop;
  }
}

/// Calls f(lane tile) for all tiles of the lower triangle from `first` (even) on: columns up to
/// `columns`, rows up to `rows`.
template <class Team, class F>
FASTLOOP_HD inline void for_lane_tiles(const Team& team, int first, int columns, int rows, F f) {
  const int column_units = (columns - first + 15) / 16, row_units = (rows - first + 31) / 32;
  for (int unit = team.warp(); unit < column_units * row_units; unit += team.warps()) {
    const int cu = unit / row_units, ru = unit - cu * row_units;
    if (32 * ru + 31 < 16 * cu) continue;  // above the diagonal
    for (int lane = team.lane(); lane < 32; lane += team.lanes())
      f(LaneTile(lane, first + 32 * ru, first + 16 * cu));
  }
}

/// Eliminates columns [0, pivots) of `a` (rows [0, rows), even stride), right-looking over the
/// pivot columns only. False: not positive definite; then `a` holds nothing of use.
template <class Team, class Matrix>
FASTLOOP_HD inline bool factor_columns(const Team& team, const Matrix& a, int pivots, int rows) {
  bool ok = true;
  for (int j = 0; j < pivots; j += kPanel) {
    const int width = pivots - j < kPanel ? pivots - j : kPanel;
    const int below = j + width;
    Triangle t;
    // Every thread that has a row factors the block for itself: cheaper than a barrier.
    const bool writer = team.rank() == team.size() - 1;  // seldom has a row
    const bool at_work = below + team.rank() < rows || writer || team.rank() == 0;
    if (at_work) {
      ok = factor_diagonal(a, j, width, t) && ok;
      for (int r = below + team.rank(); r < rows; r += team.size()) solve_row(a, j, width, r, t);
    }
    team.sync();
    if (writer) {
      double* column = a.column(j) + j;
      const int stride = a.stride(j);
      FASTLOOP_UNROLL
      for (int c = 0; c < kPanel; ++c) {
        FASTLOOP_UNROLL
        for (int r = c; r < kPanel; ++r)
          if (r < width) column[c * stride + r] = t.l[r][c];
      }
    }
    if (below < pivots) {
      for_lane_tiles(team, below, pivots, rows, [&](const LaneTile& tile) {
        double acc[4][4] = {};
        multiply_tile(a, rows, a, rows, j, below, tile, acc);
        FASTLOOP_UNROLL
        for (int c = 0; c < 4; ++c) {
          if (tile.column[c] >= pivots) continue;
          double* column = a.column(tile.column[c]);
          FASTLOOP_UNROLL
          for (int r = 0; r < 4; ++r)
            if (tile.row[r] < rows && tile.row[r] >= tile.column[c])
              column[tile.row[r]] -= acc[c][r];
        }
      });
    }
    team.sync();
  }
  return ok;
}

}  // namespace fastloop::optimization::device
