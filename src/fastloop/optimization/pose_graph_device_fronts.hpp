#pragma once

#include "fastloop/optimization/pose_graph_device_dense.hpp"
#include "fastloop/optimization/pose_graph_device_edge.hpp"
#include "fastloop/optimization/pose_graph_device_vertex.hpp"

/// What a team does for one front: gathering from edges and children, elimination. Everything is
/// gathered in a fixed order, nothing is added by atomics, so that results repeat bit by bit.
namespace fastloop::optimization::device {

FASTLOOP_HD inline int front_rows(const Front& f, int block_size) {
  return (f.pivots + f.below) * block_size + 1;
}
FASTLOOP_HD inline int even(int n) {
  return (n + 1) / 2 * 2;
}

/// Doubles of shared memory that a front needs as one task: the matrix, and the rows of two
/// children.
FASTLOOP_HD inline long long whole_front_doubles(const Front& f, int block_size) {
  const int rows = even(front_rows(f, block_size));
  return Trapezoid::doubles(rows, rows) + rows;
}
/// The same for tiles.
inline constexpr int kTileStride = kTileRows + 2;
inline constexpr int kTileDepth = 32;
inline constexpr int kTileDoubles = 2 * kTileStride * kTileRows;

/// Normal equations of vertex `vertex` (elimination index): packed entry, or component
/// `entry - kHessian` of the right-hand side.
template <EdgeModel M>
FASTLOOP_HD inline double vertex_sum(const View& v, int vertex, int entry) {
  double sum = 0;
  const int end = v.edges_begin[vertex + 1];
  for (int k = v.edges_begin[vertex]; k < end; ++k) {
    const int e = v.edges[k];
    const double value = v.normal[static_cast<long long>(e >> 1) * Model<M>::kStride + entry];
    sum += entry >= Model<M>::kHessian && (e & 1) ? -value : value;
  }
  return sum;
}

/// Row and column of a packed entry.
FASTLOOP_HD inline void unpack(int entry, int& row, int& column) {
  row = 0;
  while ((row + 1) * (row + 2) / 2 <= entry) ++row;
  column = entry - row * (row + 1) / 2;
}

/// Adds the edges of pivots [begin, end) of a front: diagonal blocks where `blocks`, and the
/// right-hand side where rhs_row >= 0. Block k lies at column (k - begin) * D of `a` and at row
/// (k - row_begin) * D.
template <EdgeModel M, class Team, class Matrix>
FASTLOOP_HD inline void add_vertices(const Team& team, const View& v, const Front& f,
                                     const Matrix& a, int begin, int end, bool blocks,
                                     int rhs_row) {
  constexpr int kD = Model<M>::kTangent, kS = Model<M>::kStride, kH = Model<M>::kHessian;
  for (int item = team.rank(); item < (end - begin) * kS; item += team.size()) {
    const int k = item / kS, entry = item - k * kS, vertex = f.first + begin + k;
    if (entry >= kH) {
      if (rhs_row >= 0) a.column(k * kD + entry - kH)[rhs_row] += vertex_sum<M>(v, vertex, entry);
      continue;
    }
    if (!blocks) continue;
    int r, c;
    unpack(entry, r, c);
    double value = vertex_sum<M>(v, vertex, entry);
    if (v.lambda > 0) value += v.lambda * damping_entry<M>(v.poses + 8 * v.pose_of[vertex], r, c);
    a.column(k * kD + c)[k * kD + r] += value;
  }
}

/// Subtracts the blocks of edges between two free vertices. Block (row, column) of the front lies
/// at block (row - row0, column - column0) of `a`.
template <EdgeModel M, class Team, class Matrix>
FASTLOOP_HD inline void add_pairs(const Team& team, const View& v, const Matrix& a, int begin,
                                  int end, int row0, int column0) {
  constexpr int kD = Model<M>::kTangent;
  for (int item = team.rank(); item < (end - begin) * kD * kD; item += team.size()) {
    const int k = item / (kD * kD), entry = item - k * (kD * kD), c = entry / kD, r = entry % kD;
    const Pair p = v.pairs[begin + k];
    double sum = 0;
    for (int slot = p.begin; slot < p.end; ++slot)
      sum += v.normal[static_cast<long long>(slot) * Model<M>::kStride + packed(r, c)];
    a.column((p.column - column0) * kD + c)[(p.row - row0) * kD + r] -= sum;
  }
}

/// Waits until all children have handed over their update matrices.
template <class Team>
FASTLOOP_HD inline void wait_for_children(const Team& team, const View& v, const Front& f) {
  for (int c = team.rank(); c < f.num_children; c += team.size()) {
    const int child = v.children[f.children + c];
    team.wait(v.front_done + child, v.fronts[child].tasks * v.factor_epoch);
  }
  team.sync();
}

/// Rows of the front in which the rows of a child's update matrix lie.
template <int D, class Team>
FASTLOOP_HD inline void find_targets(const Team& team, const View& v, const Front& f,
                                     const Front& child, std::int32_t* target) {
  const int columns = child.below * D, rhs = (f.pivots + f.below) * D;
  const std::int32_t* map = v.map + child.rows;
  for (int r = team.rank(); r <= columns; r += team.size())
    target[r] = r < columns ? map[r / D] * D + r % D : rhs;
}

/// Adds a child's update matrix.
template <int D, class Team, class Matrix>
FASTLOOP_HD inline void add_child(const Team& team, const View& v, const Front& child,
                                  const Matrix& a, const std::int32_t* target) {
  const int columns = child.below * D;
  const double* schur = v.schur + child.schur;
  constexpr int kColumns = 8;  // at a time, so that several loads are on their way
  for (int c0 = team.warp() * kColumns; c0 < columns; c0 += team.warps() * kColumns) {
    for (int r = c0 + team.lane(); r <= columns; r += team.lanes()) {
      double value[kColumns];
      FASTLOOP_UNROLL
      for (int k = 0; k < kColumns; ++k)
        value[k] = c0 + k <= r && c0 + k < columns
                       ? team.load(schur + static_cast<long long>(c0 + k) * child.schur_stride + r)
                       : 0.0;
      const int to = target[r];
      FASTLOOP_UNROLL
      for (int k = 0; k < kColumns; ++k)
        if (c0 + k <= r && c0 + k < columns) a.column(target[c0 + k])[to] += value[k];
    }
  }
  team.sync();
}

/// The part of the update matrix that the parent sees: C - L21 L21^T, straight to its place.
template <class Team>
FASTLOOP_HD inline void write_update(const Team& team, const View& v, const Front& f,
                                     const Trapezoid& a, int pivots, int rows) {
  double* schur = v.schur + f.schur;
  for_lane_tiles(team, pivots / 2 * 2, rows - 1, rows, [&](const LaneTile& tile) {
    double acc[4][4] = {};
    multiply_tile(a, rows, a, rows, 0, pivots, tile, acc);
    FASTLOOP_UNROLL
    for (int c = 0; c < 4; ++c) {
      const int column = tile.column[c];
      if (column < pivots || column >= rows - 1) continue;
      const double* from = a.column(column);
      double* to = schur + static_cast<long long>(column - pivots) * f.schur_stride - pivots;
      FASTLOOP_UNROLL
      for (int r = 0; r < 4; ++r)
        if (tile.row[r] < rows && tile.row[r] >= column)
          to[tile.row[r]] = from[tile.row[r]] - acc[c][r];
    }
  });
}

/// A front as one task.
template <EdgeModel M, class Team>
FASTLOOP_HD inline void factor_front(const Team& team, const View& v, int index, double* shared) {
  constexpr int kD = Model<M>::kTangent;
  const Front f = v.fronts[index];
  const int pivots = f.pivots * kD, rows = front_rows(f, kD), padded = even(rows);
  const Trapezoid a{shared, padded};
  const int size = static_cast<int>(Trapezoid::doubles(padded, padded));
  for (int k = team.rank(); k < size; k += team.size()) shared[k] = 0;
  team.sync();
  add_vertices<M>(team, v, f, a, 0, f.pivots, true, rows - 1);
  add_pairs<M>(team, v, a, f.pairs_begin, f.pairs_end, 0, 0);
  // Everything that does not need the children's numbers comes before the wait for them.
  std::int32_t* target[2] = {reinterpret_cast<std::int32_t*>(shared + size),
                             reinterpret_cast<std::int32_t*>(shared + size) + rows};
  for (int c = 0; c < f.num_children && c < 2; ++c)
    find_targets<kD>(team, v, f, v.fronts[v.children[f.children + c]], target[c]);
  wait_for_children(team, v, f);
  for (int c = 0; c < f.num_children; ++c) {
    const Front child = v.fronts[v.children[f.children + c]];
    if (c >= 2) {
      find_targets<kD>(team, v, f, child, target[c % 2]);
      team.sync();
    }
    add_child<kD>(team, v, child, a, target[c % 2]);
  }
  const bool ok = factor_columns(team, a, pivots, rows);
  if (!ok && team.rank() == 0) *v.failed = v.factor_epoch;
  if (f.below > 0) write_update(team, v, f, a, pivots, rows);
  team.signal(v.front_done + index);
  double* panel = v.panel + f.panel;
  for (int c = team.warp(); c < pivots; c += team.warps()) {
    const double* from = a.column(c);
    double* to = panel + static_cast<long long>(c) * f.panel_stride;
    for (int r = c + team.lane(); r < rows; r += team.lanes()) to[r] = from[r];
  }
}

}  // namespace fastloop::optimization::device
