#pragma once

#include "fastloop/optimization/pose_graph_device_dense.hpp"

/// How a front takes over its children's update matrices.
namespace fastloop::optimization::device {

/// Waits until all children have handed over their update matrices.
template <class Team>
FASTLOOP_HD inline void wait_for_children(const Team& team, const View& v, const Front& f) {
  for (int c = team.rank(); c < f.num_children; c += team.size()) {
    const int child = v.children[f.children + c];
    team.wait(v.front_done + child, v.fronts[child].tasks * v.factor_epoch);
  }
  team.sync();
}

/// Where the rows and columns of a child's update matrix lie: entry (r, c) at
/// data[offset[c] + row[r]] of the front's matrix.
struct ChildPlace {
  std::int32_t *row, *offset;
};
template <int D, class Team>
FASTLOOP_HD inline void find_place(const Team& team, const View& v, const Front& f,
                                   const Front& child, const Trapezoid& a,
                                   const ChildPlace& place) {
  const int columns = child.below * D, rhs = (f.pivots + f.below) * D;
  const std::int32_t* map = v.map + child.rows;
  for (int r = team.rank(); r <= columns; r += team.size()) {
    const int to = r < columns ? map[r / D] * D + r % D : rhs;
    place.row[r] = to;
    place.offset[r] = static_cast<std::int32_t>(a.column(to) - a.data);
  }
}

/// What the addition of a child needs to know.
struct Child {
  const double* schur;
  const std::int32_t* done;
  int columns, stride, tasks;
};
template <int D>
FASTLOOP_HD inline Child child_of(const View& v, const Front& f, int c) {
  const int index = v.children[f.children + c];
  const Front& child = v.fronts[index];
  return {v.schur + child.schur, v.front_done + index, child.below * D, child.schur_stride,
          child.tasks};
}

/// Adds a child's update matrix.
template <class Team>
FASTLOOP_HD inline void add_child(const Team& team, const Child& child, double* data,
                                  const ChildPlace& place) {
  const int columns = child.columns;
  constexpr int kColumns = 8;  // at a time, so that several loads are on their way
  constexpr int kRows = 32;
  const int groups = (columns + kColumns - 1) / kColumns;
  int turn = team.warp();  // units of kRows x kColumns go round
  for (int r0 = 0; r0 <= columns; r0 += kRows) {
    const int here = r0 / kColumns + kRows / kColumns;
    const int count = here < groups ? here : groups;
    int g = turn;
    for (; g < count; g += team.warps()) {
      const int c0 = g * kColumns;
      for (int r = r0 + team.lane(); r < r0 + kRows; r += team.lanes()) {
        double value[kColumns], old[kColumns];
        int at[kColumns];
        const auto mine = [&](int k) { return r <= columns && c0 + k <= r && c0 + k < columns; };
        FASTLOOP_UNROLL
        for (int k = 0; k < kColumns; ++k)
          value[k] =
              mine(k) ? team.load(child.schur + static_cast<long long>(c0 + k) * child.stride + r)
                      : 0.0;
        FASTLOOP_UNROLL
        for (int k = 0; k < kColumns; ++k) {
          at[k] = mine(k) ? place.offset[c0 + k] + place.row[r] : 0;
          old[k] = mine(k) ? data[at[k]] : 0.0;
        }
        FASTLOOP_UNROLL
        for (int k = 0; k < kColumns; ++k)
          if (mine(k)) data[at[k]] = old[k] + value[k];
      }
    }
    turn = g - count;
  }
  team.sync();
}

}  // namespace fastloop::optimization::device
