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

/// The copy is there after team.finish_copies() and a barrier. Its stride is odd: neither rows nor
/// columns meet bank conflicts.
template <class Team>
FASTLOOP_HD inline PanelView stage_panel(const Team& team, const double* panel, int stride,
                                         int pivots, int rows, double* room, int room_doubles) {
  const int height = rows | 1;
  if (pivots * height > room_doubles) return {panel, stride};
  for (int c = team.warp(); c < pivots; c += team.warps())
    for (int r = c + team.lane(); r < rows; r += team.lanes())
      team.copy(room + c * height + r, panel + static_cast<long long>(c) * stride + r);
  return {room, height};
}

/// Pivots [0, pivots) of b <- L^-1 b, and the rows below lose what those pivots explain.
template <class Team>
FASTLOOP_HD inline void substitute_forward(const Team& team, const PanelView& l, int pivots,
                                           int rows, double* b) {
  for (int j = 0; j < pivots; j += kStrip) {
    const int width = pivots - j < kStrip ? pivots - j : kStrip;
    if (team.warp() == 0) team.solve_lower(l.column(j) + j, l.stride, width, b + j);
    team.sync();
    for (int r = j + width + team.rank(); r < rows; r += team.size()) {
      const double* row = l.column(j) + r;
      double sum[4] = {};
      FASTLOOP_UNROLL
      for (int c = 0; c < kStrip; ++c)
        if (c < width) sum[c % 4] += row[static_cast<long long>(c) * l.stride] * b[j + c];
      b[r] -= (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }
    team.sync();
  }
}

/// Pivots [0, pivots) of x <- L^-T x, where x[pivots ..) is known.
template <class Team>
FASTLOOP_HD inline void substitute_backward(const Team& team, const PanelView& l, int pivots,
                                            int rows, double* x) {
  constexpr int kColumns = 4;  // of a warp at a time
  for (int c0 = team.warp() * kColumns; c0 < pivots; c0 += team.warps() * kColumns) {
    double sum[kColumns] = {};
    for (int r = pivots + team.lane(); r < rows; r += team.lanes()) {
      FASTLOOP_UNROLL
      for (int k = 0; k < kColumns; ++k)
        if (c0 + k < pivots) sum[k] += l.column(c0 + k)[r] * x[r];
    }
    FASTLOOP_UNROLL
    for (int k = 0; k < kColumns; ++k) sum[k] = team.sum(sum[k]);
    FASTLOOP_UNROLL
    for (int k = 0; k < kColumns; ++k)
      if (team.lane() == 0 && c0 + k < pivots) x[c0 + k] -= sum[k];
  }
  team.sync();
  for (int j = (pivots - 1) / kStrip * kStrip; j >= 0; j -= kStrip) {
    const int width = pivots - j < kStrip ? pivots - j : kStrip;
    if (team.warp() == 0) team.solve_upper(l.column(j) + j, l.stride, width, x + j);
    team.sync();
    if (j == 0) break;
    for (int c = team.rank(); c < j; c += team.size()) {
      const double* column = l.column(c) + j;
      double sum[4] = {};
      FASTLOOP_UNROLL
      for (int r = 0; r < kStrip; ++r)
        if (r < width) sum[r % 4] += column[r] * x[j + r];
      x[c] -= (sum[0] + sum[1]) + (sum[2] + sum[3]);
    }
    team.sync();
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
  team.finish_copies();
  for (int c = 0; c < f.num_children; ++c) {
    const int index_of_child = v.children[f.children + c];
    const Front& child = v.fronts[index_of_child];
    const std::int32_t* map = v.map + child.rows;
    const double* rhs = v.rhs + static_cast<long long>(child.rhs) * kD;
    const int count = child.below * kD;
    // Looked up before the wait.
    int to = team.rank() < count ? map[team.rank() / kD] * kD + team.rank() % kD : 0;
    if (team.rank() == 0) team.wait(v.forward_done + index_of_child, v.forward_epoch);
    team.sync();
    for (int k = team.rank(); k < count; k += team.size()) {
      if (k != team.rank()) to = map[k / kD] * kD + k % kD;
      b[to] += team.load(rhs + k);
    }
  }
  team.sync();
  substitute_forward(team, l, pivots, rows, b);
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
  team.finish_copies();
  team.sync();
  if (team.warp() == 0) {
    double norm = 0;
    for (int c = team.lane(); c < pivots; c += team.lanes()) norm += x[c] * x[c];
    norm = team.sum(norm);
    if (team.lane() == 0) v.front_norm[index] = norm;
  }
  const auto source = [&](int k) { return v.rows[f.rows + k / kD] * kD + k % kD; };
  const int count = f.below * kD;
  int from = team.rank() < count ? source(team.rank()) : 0;  // looked up before the wait
  if (f.parent >= 0 && team.rank() == 0) team.wait(v.descent_done + f.parent, v.descent_epoch);
  team.sync();
  for (int k = team.rank(); k < count; k += team.size()) {
    if (k != team.rank()) from = source(k);
    x[pivots + k] = team.load(v.step + from);
  }
  team.sync();
  substitute_backward(team, l, pivots, rows, x);
  for (int c = team.rank(); c < pivots; c += team.size()) v.step[f.first * kD + c] = x[c];
  team.publish(v.descent_done + index, v.descent_epoch);
  for (int k = team.rank(); k < f.pivots; k += team.size()) {
    const long long pose = v.pose_of[f.first + k];
    move_pose<M>(v.poses + 8 * pose, x + k * kD, v.next_poses + 8 * pose);
  }
}

/// Linearises the edges of one chunk at `poses`; the sum of their costs is left in chunk_cost.
/// `shared`: one number per warp, and kChunk edges: neighbouring threads then write neighbouring
/// numbers of `normal`.
template <EdgeModel M, class Team>
FASTLOOP_HD inline void linearize_chunk(const Team& team, const View& v, int chunk,
                                        const double* poses, double* normal, double* shared) {
  constexpr int kStride = Model<M>::kStride;
  double cost = 0;
  const int begin = chunk * kChunk;
  const int end = begin + kChunk < v.num_slots ? begin + kChunk : v.num_slots;
  double* staged = shared + team.warps();
  for (int slot = begin + team.rank(); slot < end; slot += team.size()) {
    const int edge = v.edge_of_slot[slot], which = v.information[edge];
    double* out = staged + (slot - begin) * kStride;
    if (which < 0) {  // rejected
      for (int k = 0; k < kStride; ++k) out[k] = 0;
      v.squared[slot] = 0;
      continue;
    }
    double local[kStride], squared;
    cost += linearize_edge<M>(poses + 8 * static_cast<long long>(v.from[slot]),
                              poses + 8 * static_cast<long long>(v.to[slot]),
                              v.measurement + 8 * static_cast<long long>(edge),
                              v.matrices + 28 * (which >> 1), (which & 1) ? v.robust_kernel : 0,
                              v.robust_width, local, squared);
    FASTLOOP_UNROLL
    for (int k = 0; k < kStride; ++k) out[k] = local[k];
    v.squared[slot] = squared;
  }
  cost = team.sum(cost);
  if (team.lane() == 0) shared[team.warp()] = cost;
  team.sync();
  double* to = normal + static_cast<long long>(begin) * kStride;
  for (int k = team.rank(); k < (end - begin) * kStride; k += team.size()) to[k] = staged[k];
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
