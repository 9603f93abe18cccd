#pragma once

#include "fastloop/optimization/pose_graph_device_tiles.hpp"

/// The passes besides the factorisation: the two substitutions with the factor, and the edges.
namespace fastloop::optimization::device {

/// The pivot columns of a front: in shared memory where there is room for a copy.
struct PanelView {
  const double* data;
  int stride;
  FASTLOOP_HD const double* column(int c) const {
    return data + static_cast<long long>(c) * stride;
  }
};

template <class Team>
FASTLOOP_HD inline PanelView stage_panel(const Team& team, const double* panel, int stride,
                                         int pivots, int rows, double* room, int room_doubles) {
  const int height = even(rows);
  if (pivots * height > room_doubles) return {panel, stride};
  for (int c = team.warp(); c < pivots; c += team.warps())
    for (int r = c + team.lane(); r < rows; r += team.lanes())
      room[c * height + r] = panel[static_cast<long long>(c) * stride + r];
  return {room, height};
}

FASTLOOP_HD inline void load_triangle(const PanelView& l, int first, int width, Triangle& t) {
  FASTLOOP_UNROLL
  for (int c = 0; c < kPanel; ++c) {
    FASTLOOP_UNROLL
    for (int r = c; r < kPanel; ++r)
      t.l[r][c] = r < width ? l.column(first + c)[first + r] : r == c;
  }
}

/// Right-hand side of one front with the factor of an earlier factorisation: refreshes L^-1 b.
template <EdgeModel M, class Team>
FASTLOOP_HD inline void forward_front(const Team& team, const View& v, int index, double* shared,
                                      int shared_doubles) {
  constexpr int kD = Model<M>::kTangent;
  const Front f = v.fronts[index];
  const int pivots = f.pivots * kD, rows = (f.pivots + f.below) * kD;
  double* b = shared;
  double* panel = v.panel + f.panel;
  const PanelView l = stage_panel(team, panel, f.panel_stride, pivots, rows, shared + even(rows),
                                  shared_doubles - even(rows));
  for (int k = team.rank(); k < rows; k += team.size())
    b[k] = k < pivots ? vertex_sum<M>(v, f.first + k / kD, Model<M>::kHessian + k % kD) : 0.0;
  for (int c = team.rank(); c < f.num_children; c += team.size())
    team.wait(v.forward_done + v.children[f.children + c], v.forward_epoch);
  team.sync();
  for (int c = 0; c < f.num_children; ++c) {
    const Front& child = v.fronts[v.children[f.children + c]];
    const double* rhs = v.rhs + static_cast<long long>(child.rhs) * kD;
    for (int k = team.rank(); k < child.below * kD; k += team.size())
      b[v.map[child.rows + k / kD] * kD + k % kD] += team.load(rhs + k);
    team.sync();
  }
  Triangle t;
  load_triangle(l, 0, pivots < kPanel ? pivots : kPanel, t);
  for (int j = 0; j < pivots; j += kPanel) {
    const int width = pivots - j < kPanel ? pivots - j : kPanel;
    double y[kPanel];
    FASTLOOP_UNROLL
    for (int c = 0; c < kPanel; ++c) y[c] = c < width ? b[j + c] : 0.0;
    FASTLOOP_UNROLL
    for (int c = 0; c < kPanel; ++c) {
      y[c] *= t.l[c][c];
      FASTLOOP_UNROLL
      for (int o = c + 1; o < kPanel; ++o) y[o] -= y[c] * t.l[o][c];
    }
    // The next triangle is on its way while the rows are treated.
    if (const int next = j + kPanel; next < pivots)
      load_triangle(l, next, pivots - next < kPanel ? pivots - next : kPanel, t);
    for (int r = j + width + team.rank(); r < rows; r += team.size()) {
      double sum = b[r];
      FASTLOOP_UNROLL
      for (int c = 0; c < kPanel; ++c)
        if (c < width) sum -= l.column(j + c)[r] * y[c];
      b[r] = sum;
    }
    team.sync();
    if (team.rank() == 0) {
      FASTLOOP_UNROLL
      for (int c = 0; c < kPanel; ++c)
        if (c < width) b[j + c] = y[c];
    }
  }
  team.sync();
  double* out = v.rhs + static_cast<long long>(f.rhs) * kD;
  for (int k = team.rank(); k < rows - pivots; k += team.size()) out[k] = b[pivots + k];
  team.publish(v.forward_done + index, v.forward_epoch);
  for (int c = team.rank(); c < pivots; c += team.size())
    panel[static_cast<long long>(c) * f.panel_stride + rows] = b[c];
}

/// Step of the pivots of one front, once that of the front above is known; moves their poses.
template <EdgeModel M, class Team>
FASTLOOP_HD inline void backward_front(const Team& team, const View& v, int index, double* shared,
                                       int shared_doubles) {
  constexpr int kD = Model<M>::kTangent;
  const Front f = v.fronts[index];
  const int pivots = f.pivots * kD, rows = (f.pivots + f.below) * kD;
  double* x = shared;
  const double* panel = v.panel + f.panel;
  const PanelView l = stage_panel(team, panel, f.panel_stride, pivots, rows, shared + even(rows),
                                  shared_doubles - even(rows));
  for (int c = team.rank(); c < pivots; c += team.size())
    x[c] = panel[static_cast<long long>(c) * f.panel_stride + rows];
  team.sync();
  if (team.warp() == 0) {
    double norm = 0;
    for (int c = team.lane(); c < pivots; c += team.lanes()) norm += x[c] * x[c];
    norm = team.sum(norm);
    if (team.lane() == 0) v.front_norm[index] = norm;
  }
  if (f.parent >= 0 && team.rank() == 0) team.wait(v.descent_done + f.parent, v.descent_epoch);
  team.sync();
  for (int k = team.rank(); k < f.below * kD; k += team.size())
    x[pivots + k] = team.load(v.step + v.rows[f.rows + k / kD] * kD + k % kD);
  team.sync();
  for (int c = team.warp(); c < pivots; c += team.warps()) {
    const double* column = l.column(c);
    double sum = 0;
    for (int r = pivots + team.lane(); r < rows; r += team.lanes()) sum += column[r] * x[r];
    sum = team.sum(sum);
    if (team.lane() == 0) x[c] -= sum;
  }
  team.sync();
  const int last = (pivots - 1) / kPanel * kPanel;
  Triangle t;
  load_triangle(l, last, pivots - last, t);
  for (int j = last; j >= 0; j -= kPanel) {
    const int width = pivots - j < kPanel ? pivots - j : kPanel;
    double y[kPanel];
    FASTLOOP_UNROLL
    for (int c = 0; c < kPanel; ++c) y[c] = c < width ? x[j + c] : 0.0;
    FASTLOOP_UNROLL
    for (int c = kPanel - 1; c >= 0; --c) {
      FASTLOOP_UNROLL
      for (int o = c + 1; o < kPanel; ++o) y[c] -= y[o] * t.l[o][c];
      y[c] *= t.l[c][c];
    }
    if (j > 0) load_triangle(l, j - kPanel, kPanel, t);
    for (int c = team.rank(); c < j; c += team.size()) {
      const double* column = l.column(c) + j;
      double sum = x[c];
      FASTLOOP_UNROLL
      for (int k = 0; k < kPanel; ++k)
        if (k < width) sum -= column[k] * y[k];
      x[c] = sum;
    }
    team.sync();
    if (team.rank() == 0) {
      FASTLOOP_UNROLL
      for (int c = 0; c < kPanel; ++c)
        if (c < width) x[j + c] = y[c];
    }
  }
  team.sync();
  for (int c = team.rank(); c < pivots; c += team.size()) v.step[f.first * kD + c] = x[c];
  team.publish(v.descent_done + index, v.descent_epoch);
  for (int k = team.rank(); k < f.pivots; k += team.size()) {
    const long long pose = v.pose_of[f.first + k];
    move_pose<M>(v.poses + 8 * pose, x + k * kD, v.next_poses + 8 * pose);
  }
}

/// Linearises the edges of one chunk at `poses`; the sum of their costs is left in chunk_cost.
/// `shared`: one number per warp.
template <EdgeModel M, class Team>
FASTLOOP_HD inline void linearize_chunk(const Team& team, const View& v, int chunk,
                                        const double* poses, double* normal, double* shared) {
  double cost = 0;
  const int end = (chunk + 1) * kChunk < v.num_slots ? (chunk + 1) * kChunk : v.num_slots;
  for (int slot = chunk * kChunk + team.rank(); slot < end; slot += team.size()) {
    const int edge = v.edge_of_slot[slot], which = v.information[edge];
    double* out = normal + static_cast<long long>(slot) * Model<M>::kStride;
    if (which < 0) {  // rejected
      for (int k = 0; k < Model<M>::kStride; ++k) out[k] = 0;
      v.squared[slot] = 0;
      continue;
    }
    double local[Model<M>::kStride], squared;
    cost += linearize_edge<M>(poses + 8 * static_cast<long long>(v.from[slot]),
                              poses + 8 * static_cast<long long>(v.to[slot]),
                              v.measurement + 8 * static_cast<long long>(edge),
                              v.matrices + 28 * (which >> 1), (which & 1) ? v.robust_kernel : 0,
                              v.robust_width, local, squared);
    FASTLOOP_UNROLL
    for (int k = 0; k < Model<M>::kStride; ++k) out[k] = local[k];
    v.squared[slot] = squared;
  }
  cost = team.sum(cost);
  if (team.lane() == 0) shared[team.warp()] = cost;
  team.sync();
  if (team.rank() == 0) {
    double total = 0;
    for (int w = 0; w < team.warps(); ++w) total += shared[w];
    v.chunk_cost[chunk] = total;
  }
}

/// Sum of `n` numbers in an order that depends on n and the team's size alone. `shared`: one number
/// per warp. Valid for rank 0.
template <class Team>
FASTLOOP_HD inline double total(const Team& team, const double* values, int n, double* shared) {
  double sum = 0;
  for (int k = team.rank(); k < n; k += team.size()) sum += team.load(values + k);
  sum = team.sum(sum);
  team.sync();
  if (team.lane() == 0) shared[team.warp()] = sum;
  team.sync();
  sum = 0;
  for (int w = 0; w < team.warps(); ++w) sum += shared[w];
  return sum;
}

/// f.operator()<model>()
template <class F>
auto with_model(EdgeModel model, F f) {
  switch (model) {
    case EdgeModel::kYaw:
      return f.template operator()<EdgeModel::kYaw>();
    case EdgeModel::kSe3:
      return f.template operator()<EdgeModel::kSe3>();
    case EdgeModel::kSim3:
      return f.template operator()<EdgeModel::kSim3>();
    case EdgeModel::kSim3FixedScale:
      break;
  }
  return f.template operator()<EdgeModel::kSim3FixedScale>();
}

}  // namespace fastloop::optimization::device
