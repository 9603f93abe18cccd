#pragma once

#include "fastloop/optimization/pose_graph_device_fronts.hpp"

/// What a team does for one tile of a front that is too large for one task.
namespace fastloop::optimization::device {

/// Rows [0, rows) of `x`, `pivots` columns: x <- x L^-T with the factor of `factor_columns`.
template <class Team>
FASTLOOP_HD inline void solve_columns(const Team& team, const Square& x, const Square& l,
                                      int pivots, int rows) {
  for (int j = 0; j < pivots; j += kPanel) {
    const int width = pivots - j < kPanel ? pivots - j : kPanel;
    Triangle t;
    const double* diagonal = l.column(j) + j;
    FASTLOOP_UNROLL
    for (int c = 0; c < kPanel; ++c) {
      FASTLOOP_UNROLL
      for (int r = c; r < kPanel; ++r) t.l[r][c] = r < width ? diagonal[c * l.rows + r] : r == c;
    }
    for (int r = team.rank(); r < rows; r += team.size()) solve_row(x, j, width, r, t);
    team.sync();
    const int first = j + width;
    for (int unit = team.warp(); unit < 2 * ((pivots - first + 15) / 16); unit += team.warps()) {
      for (int lane = team.lane(); lane < 32; lane += team.lanes()) {
        const LaneTile tile(lane, 32 * (unit % 2), first + 16 * (unit / 2));
        double acc[4][4] = {};
        multiply_tile(x, rows, l, pivots, j, first, tile, acc);
        FASTLOOP_UNROLL
        for (int c = 0; c < 4; ++c) {
          if (tile.column[c] >= pivots) continue;
          double* column = x.column(tile.column[c]);
          FASTLOOP_UNROLL
          for (int r = 0; r < 4; ++r)
            if (tile.row[r] < rows) column[tile.row[r]] -= acc[c][r];
        }
      }
    }
    team.sync();
  }
}

/// First block of tile t of a tiled front, and the block after its last.
template <int D>
FASTLOOP_HD inline void tile_range(const Front& f, int t, int& begin, int& end) {
  constexpr int kBlocks = tile_blocks(D);
  const int pivot_tiles = (f.pivots + kBlocks - 1) / kBlocks;
  const int limit = t < pivot_tiles ? f.pivots : f.pivots + f.below;
  begin = t < pivot_tiles ? t * kBlocks : f.pivots + (t - pivot_tiles) * kBlocks;
  end = begin + kBlocks < limit ? begin + kBlocks : limit;
}
FASTLOOP_HD inline int count_tiles(int blocks, int per_tile) {
  return (blocks + per_tile - 1) / per_tile;
}

/// First of the child's blocks that lies at or after a block of the parent.
FASTLOOP_HD inline int first_at(const std::int32_t* map, int count, int block) {
  int low = 0, high = count;
  while (low < high) {
    const int middle = (low + high) / 2;
    if (map[middle] < block) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

/// Adds what a child's update matrix has in a tile.
template <int D, class Team>
FASTLOOP_HD inline void add_child_to_tile(const Team& team, const View& v, const Front& child,
                                          const Square& a, int row_begin, int row_end,
                                          int column_begin, int column_end, int rhs_row) {
  const std::int32_t* map = v.map + child.rows;
  const int c_begin = first_at(map, child.below, column_begin) * D;
  const int c_end = first_at(map, child.below, column_end) * D;
  const int r_begin = first_at(map, child.below, row_begin) * D;
  int r_end = first_at(map, child.below, row_end) * D;
  const int rhs = child.below * D;
  const double* schur = v.schur + child.schur;
  const int extra = rhs_row >= 0 ? 1 : 0;
  for (int c = c_begin + team.warp(); c < c_end; c += team.warps()) {
    double* column = a.column((map[c / D] - column_begin) * D + c % D);
    const double* from = schur + static_cast<long long>(c) * child.schur_stride;
    for (int k = r_begin + team.lane(); k < r_end + extra; k += team.lanes()) {
      const bool last = k == r_end;
      const int r = last ? rhs : k;
      if (r < c) continue;
      const int to = last ? rhs_row : (map[r / D] - row_begin) * D + r % D;
      column[to] += team.load(from + r);
    }
  }
  team.sync();
}

/// Subtracts L(row tile, k) L(column tile, k)^T for all pivot tiles k to the left.
template <int D, class Team>
FASTLOOP_HD inline void subtract_left(const Team& team, const View& v, const Front& f,
                                      const Task& task, const Square& c, double* buffer, int row0,
                                      int rows, int column0, int columns, int left_tiles) {
  const int tiles = count_tiles(f.pivots, tile_blocks(D)) + count_tiles(f.below, tile_blocks(D));
  const Square x{buffer, kTileStride}, y{buffer + kTileStride * kTileDepth, kTileStride};
  const double* panel = v.panel + f.panel;
  typename Team::TileSum sum(team);
  for (int t = 0; t < left_tiles; ++t) {
    if (team.rank() == 0) {
      team.wait(v.tile_done + f.tile_flags + t * tiles + task.row_tile, v.factor_epoch);
      team.wait(v.tile_done + f.tile_flags + t * tiles + task.column_tile, v.factor_epoch);
    }
    team.sync();
    int begin, end;
    tile_range<D>(f, t, begin, end);
    for (int k0 = begin * D; k0 < end * D; k0 += kTileDepth) {
      const int depth = end * D - k0 < kTileDepth ? end * D - k0 : kTileDepth;
      for (int k = team.rank(); k < kTileRows * kTileDepth; k += team.size()) {
        const int column = k / kTileRows, r = k % kTileRows;
        const double* from = panel + static_cast<long long>(k0 + column) * f.panel_stride;
        x.column(column)[r] = column < depth && r < rows ? team.load(from + row0 + r) : 0.0;
        y.column(column)[r] = column < depth && r < columns ? team.load(from + column0 + r) : 0.0;
      }
      team.sync();
      sum.add_product(x, y, c);
      team.sync();
    }
  }
  sum.subtract_from(c);
  team.sync();
}

/// One tile of a large front: gathered, updated by the tiles to its left as they become ready, and,
/// among the pivots, solved.
template <EdgeModel M, class Team>
FASTLOOP_HD inline void factor_tile(const Team& team, const View& v, const Task& task,
                                    double* shared) {
  constexpr int kD = Model<M>::kTangent;
  const Front f = v.fronts[task.front];
  const int pivot_tiles = count_tiles(f.pivots, tile_blocks(kD));
  const int tiles = pivot_tiles + count_tiles(f.below, tile_blocks(kD));
  int row_begin, row_end, column_begin, column_end;
  tile_range<kD>(f, task.row_tile, row_begin, row_end);
  tile_range<kD>(f, task.column_tile, column_begin, column_end);
  const bool last = task.row_tile == tiles - 1, pivot = task.column_tile < pivot_tiles;
  const int rows = (row_end - row_begin) * kD + (last ? 1 : 0);
  const int columns = (column_end - column_begin) * kD;
  const Square c{shared, kTileStride};
  double* buffer = shared + kTileStride * kTileRows;
  for (int k = team.rank(); k < kTileStride * kTileRows; k += team.size()) shared[k] = 0;
  team.sync();
  const int rhs_row = last ? rows - 1 : -1;
  const bool diagonal = task.row_tile == task.column_tile;
  if (pivot) {
    if (diagonal || last)
      add_vertices<M>(team, v, f, c, column_begin, column_end, diagonal, rhs_row);
    add_pairs<M>(team, v, c, task.pairs_begin, task.pairs_end, row_begin, column_begin);
  }
  wait_for_children(team, v, f);
  for (int k = 0; k < f.num_children; ++k)
    add_child_to_tile<kD>(team, v, v.fronts[v.children[f.children + k]], c, row_begin, row_end,
                          column_begin, column_end, rhs_row);
  const int left = task.column_tile < pivot_tiles ? task.column_tile : pivot_tiles;
  if (left > 0)
    subtract_left<kD>(team, v, f, task, c, buffer, row_begin * kD, rows, column_begin * kD, columns,
                      left);
  double* panel = v.panel + f.panel;
  if (diagonal && pivot) {
    const bool ok = factor_columns(team, c, columns, rows);
    if (!ok && team.rank() == 0) *v.failed = v.factor_epoch;
  } else if (pivot) {
    if (team.rank() == 0)
      team.wait(v.tile_done + f.tile_flags + task.column_tile * tiles + task.column_tile,
                v.factor_epoch);
    team.sync();
    const Square l{buffer, kTileStride};
    for (int k = team.rank(); k < columns * columns; k += team.size()) {
      const int j = k / columns, r = k % columns;
      if (r >= j)
        l.column(j)[r] =
            team.load(panel + static_cast<long long>(column_begin * kD + j) * f.panel_stride +
                      column_begin * kD + r);
    }
    team.sync();
    solve_columns(team, c, l, columns, rows);
  }
  double* out =
      pivot ? panel + static_cast<long long>(column_begin * kD) * f.panel_stride + row_begin * kD
            : v.schur + f.schur +
                  static_cast<long long>((column_begin - f.pivots) * kD) * f.schur_stride +
                  (row_begin - f.pivots) * kD;
  const int stride = pivot ? f.panel_stride : f.schur_stride;
  for (int j = team.warp(); j < columns; j += team.warps()) {
    const double* from = c.column(j);
    double* to = out + static_cast<long long>(j) * stride;
    for (int r = (diagonal ? j : 0) + team.lane(); r < rows; r += team.lanes()) to[r] = from[r];
  }
  if (pivot) {
    team.publish(v.tile_done + f.tile_flags + task.column_tile * tiles + task.row_tile,
                 v.factor_epoch);
  } else {
    team.signal(v.front_done + task.front);
  }
}

}  // namespace fastloop::optimization::device
