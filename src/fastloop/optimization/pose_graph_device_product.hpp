#pragma once

#include "fastloop/optimization/pose_graph_device_math.hpp"
#include "fastloop/optimization/pose_graph_device_types.hpp"

/// Products of dense matrices by the warps of a team, see pose_graph_device_dense.hpp.
namespace fastloop::optimization::device {

/// The 4 x 4 entries that a lane computes of a unit of 32 rows and 16 columns, as the device's
/// matrix instruction deals them out.
struct LaneTile {
  int lane, row0, column0;
  int row[4], column[4];
  FASTLOOP_HD LaneTile(int lane_of_warp, int first_row, int first_column)
      : lane(lane_of_warp), row0(first_row), column0(first_column) {
    for (int k = 0; k < 4; ++k) {
      row[k] = row0 + lane / 4 + 8 * k;
      column[k] = column0 + 2 * (lane % 4) + (k & 1) + 8 * (k / 2);
    }
  }
};

/// acc += (rows of the tile in `x`) x (columns of the tile as rows of `y`), over up to kPanel
/// columns of stride x_stride and y_stride. `x` and `y` point at row 0 of the first of them; their
/// rows end at x_rows and y_rows, and what the products beyond hold is of no use. A whole warp
/// calls.
FASTLOOP_HD inline void multiply_panel(const double* x, int x_stride, int x_rows, const double* y,
                                       int y_stride, int y_rows, int width, const LaneTile& tile,
                                       double (&acc)[4][4]) {
  const auto at = [](int row, int rows) { return row < rows ? row : rows - 1; };
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  const int group = tile.lane / 4, k0 = tile.lane % 4, k1 = k0 + 4;
  double a[4][2], b[2][2];
  FASTLOOP_UNROLL
  for (int r = 0; r < 4; ++r) {
    const double* from = x + at(tile.row[r], x_rows);
    a[r][0] = k0 < width ? from[k0 * x_stride] : 0.0;
    a[r][1] = k1 < width ? from[k1 * x_stride] : 0.0;
  }
  FASTLOOP_UNROLL
  for (int c = 0; c < 2; ++c) {
    const double* from = y + at(tile.column0 + 8 * c + group, y_rows);
    b[c][0] = k0 < width ? from[k0 * y_stride] : 0.0;
    b[c][1] = k1 < width ? from[k1 * y_stride] : 0.0;
  }
  FASTLOOP_UNROLL
  for (int r = 0; r < 4; r += 2) {
    FASTLOOP_UNROLL
    for (int c = 0; c < 2; ++c)
      asm volatile(
          "mma.sync.aligned.m16n8k8.row.col.f64.f64.f64.f64 {%0, %1, %2, %3}, {%4, %5, %6, %7}, "
          "{%8, %9}, {%0, %1, %2, %3};"
          : "+d"(acc[2 * c][r]), "+d"(acc[2 * c + 1][r]), "+d"(acc[2 * c][r + 1]),
            "+d"(acc[2 * c + 1][r + 1])
          : "d"(a[r][0]), "d"(a[r + 1][0]), "d"(a[r][1]), "d"(a[r + 1][1]), "d"(b[c][0]),
            "d"(b[c][1]));
  }
#else
  for (int k = 0; k < width; ++k) {
    const double *row = x + k * x_stride, *column = y + k * y_stride;
    FASTLOOP_UNROLL
    for (int c = 0; c < 4; ++c) {
      const double factor = column[at(tile.column[c], y_rows)];
      FASTLOOP_UNROLL
      for (int r = 0; r < 4; ++r) acc[c][r] += row[at(tile.row[r], x_rows)] * factor;
    }
  }
#endif
}

/// The same over columns [begin, end), where `begin` starts a panel.
template <class Matrix>
FASTLOOP_HD inline void multiply_tile(const Matrix& x, int x_rows, const Matrix& y, int y_rows,
                                      int begin, int end, const LaneTile& tile,
                                      double (&acc)[4][4]) {
  FASTLOOP_UNROLL
  for (int k = begin; k < end; k += kPanel)
    multiply_panel(x.column(k), x.stride(k), x_rows, y.column(k), y.stride(k), y_rows,
                   end - k < kPanel ? end - k : kPanel, tile, acc);
}

/// Calls f(lane tile) for all tiles of the lower triangle from `first` on: columns up to `columns`,
/// rows up to `rows`. Units of one warp go round, so that all warps get as many.
template <class Team, class F>
FASTLOOP_HD inline void for_lane_tiles(const Team& team, int first, int columns, int rows,
                                       bool spare_first_warp, F f) {
  const int skip = spare_first_warp ? 1 : 0, warps = team.warps() - skip;
  if (team.warp() < skip) return;
  const int column_units = (columns - first + 15) / 16, row_units = (rows - first + 31) / 32;
  int turn = team.warp() - skip;
  for (int ru = 0; ru < row_units; ++ru) {
    const int count = 2 * ru + 2 < column_units ? 2 * ru + 2 : column_units;  // to the diagonal
    int cu = turn;
    for (; cu < count; cu += warps)
      for (int lane = team.lane(); lane < 32; lane += team.lanes())
        f(LaneTile(lane, first + 32 * ru, first + 16 * cu));
    turn = cu - count;
  }
}

}  // namespace fastloop::optimization::device
