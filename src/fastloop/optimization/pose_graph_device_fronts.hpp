#pragma once

#include "fastloop/optimization/pose_graph_device_children.hpp"
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

/// Doubles of shared memory that a front needs as one task: the matrix, and where two children's
/// rows and columns lie in it.
FASTLOOP_HD inline long long whole_front_doubles(const Front& f, int block_size) {
  const int rows = even(front_rows(f, block_size));
  return Trapezoid::doubles(rows, rows) + 2 * rows;
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
  constexpr int kLoads = 4;  // on their way at once
  for (int k = v.edges_begin[vertex]; k < end; k += kLoads) {
    int e[kLoads];
    double value[kLoads];
    FASTLOOP_UNROLL
    for (int i = 0; i < kLoads; ++i) e[i] = k + i < end ? v.edges[k + i] : -1;
    FASTLOOP_UNROLL
    for (int i = 0; i < kLoads; ++i)
      value[i] =
          e[i] >= 0 ? v.normal[static_cast<long long>(e[i] >> 1) * Model<M>::kStride + entry] : 0.0;
    FASTLOOP_UNROLL
    for (int i = 0; i < kLoads; ++i)
      sum += entry >= Model<M>::kHessian && e[i] >= 0 && (e[i] & 1) ? -value[i] : value[i];
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
  constexpr int kItems = 4;  // whose loads are on their way at once
  const int items = (end - begin) * kD * kD;
  for (int first = team.rank(); first < items; first += kItems * team.size()) {
    Pair p[kItems];
    double sum[kItems];
    int at[kItems], r[kItems], c[kItems];
    FASTLOOP_UNROLL
    for (int i = 0; i < kItems; ++i) {
      const int item = first + i * team.size(), k = item / (kD * kD), entry = item - k * (kD * kD);
      c[i] = entry / kD;
      r[i] = entry - c[i] * kD;
      at[i] = packed(r[i], c[i]);
      p[i] = item < items ? v.pairs[begin + k] : Pair{0, 0, 0, 0};
    }
    const auto value = [&](int i, int slot) {
      return v.normal[static_cast<long long>(slot) * Model<M>::kStride + at[i]];
    };
    FASTLOOP_UNROLL
    for (int i = 0; i < kItems; ++i) sum[i] = p[i].begin < p[i].end ? value(i, p[i].begin) : 0.0;
    FASTLOOP_UNROLL
    for (int i = 0; i < kItems; ++i) {
      for (int slot = p[i].begin + 1; slot < p[i].end; ++slot) sum[i] += value(i, slot);
      if (p[i].begin < p[i].end)
        a.column((p[i].column - column0) * kD + c[i])[(p[i].row - row0) * kD + r[i]] -= sum[i];
    }
  }
}

/// The part of the update matrix that the parent sees: C - L21 L21^T, straight to its place.
template <class Team>
FASTLOOP_HD inline void write_update(const Team& team, const View& v, const Front& f,
                                     const Trapezoid& a, int pivots, int rows) {
  double* schur = v.schur + f.schur;
  for_lane_tiles(team, pivots / 2 * 2, rows - 1, rows, false, [&](const LaneTile& tile) {
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
  std::int32_t* room = reinterpret_cast<std::int32_t*>(shared + size);
  const auto place = [&](int c) {
    return ChildPlace{room + (c & 1) * 2 * padded, room + ((c & 1) * 2 + 1) * padded};
  };
  const auto find = [&](int c) {
    find_place<kD>(team, v, f, v.fronts[v.children[f.children + c]], a, place(c));
  };
  const Child first = f.num_children > 0 ? child_of<kD>(v, f, 0) : Child{};
  const Child second = f.num_children > 1 ? child_of<kD>(v, f, 1) : Child{};
  if (f.num_children > 0) find(0);
  if (f.num_children > 1) find(1);
  // The child that is ready last stands last: the others are added meanwhile.
  for (int c = 0; c < f.num_children; ++c) {
    const Child child = c == 0 ? first : c == 1 ? second : child_of<kD>(v, f, c);
    if (c >= 2) find(c);
    if (team.rank() == 0) team.wait(child.done, child.tasks * v.factor_epoch);
    team.sync();
    add_child(team, child, shared, place(c));
  }
  if (f.num_children == 0) team.sync();
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
