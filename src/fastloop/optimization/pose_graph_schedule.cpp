#include "fastloop/optimization/pose_graph_schedule.hpp"

#include <algorithm>
#include <numeric>

#include "fastloop/optimization/pose_graph_device_tiles.hpp"

namespace fastloop::optimization::device {
namespace {

class Builder {
 public:
  Builder(const ScheduleInput& input, const block::Graph& graph, const Dissection& dissection,
          std::size_t max_shared_doubles, Schedule& schedule)
      : input_(input),
        graph_(graph),
        dissection_(dissection),
        max_shared_(max_shared_doubles),
        out_(schedule) {}

  void run() {
    out_.block_size = input_.block_size;
    out_.num_vertices = graph_.size();
    out_.num_poses = input_.num_poses;
    order_vertices();
    find_fronts();
    link_children();
    map_rows();
    assign_memory();
    assign_slots();
    order_tasks();
  }

 private:
  void order_vertices() {
    const int n = graph_.size();
    position_.resize(n);
    front_of_.resize(n);
    out_.pose_of.resize(n);
    for (int k = 0; k < n; ++k) {
      position_[dissection_.vertices[k]] = k;
      out_.pose_of[k] = (*input_.free_pose)[dissection_.vertices[k]];
    }
    for (int k = 0; k < dissection_.size(); ++k)
      for (int i = dissection_.begin[k]; i < dissection_.begin[k + 1]; ++i) front_of_[i] = k;
  }

  /// Rows of a front: later neighbours of its pivots, and what its children leave.
  void find_fronts() {
    const int n = dissection_.size();
    out_.fronts.assign(n, Front());
    out_.rows.clear();
    std::vector<int> mark(graph_.size(), -1), head(n, -1), next(n, -1);
    for (int k = 0; k < n; ++k) {
      Front& f = out_.fronts[k];
      f.first = dissection_.begin[k];
      f.pivots = dissection_.begin[k + 1] - f.first;
      f.rows = static_cast<std::int32_t>(out_.rows.size());
      const int end = f.first + f.pivots;
      const auto add = [&](int row) {
        if (row < end || mark[row] == k) return;
        mark[row] = k;
        out_.rows.push_back(row);
      };
      for (int i = f.first; i < end; ++i) {
        const int v = dissection_.vertices[i];
        for (int e = graph_.begin[v]; e < graph_.begin[v + 1]; ++e)
          add(position_[graph_.neighbour[e]]);
      }
      for (int child = head[k]; child >= 0; child = next[child]) {
        const Front& c = out_.fronts[child];
        for (int r = 0; r < c.below; ++r) add(out_.rows[c.rows + r]);
      }
      f.below = static_cast<std::int32_t>(out_.rows.size()) - f.rows;
      std::sort(out_.rows.begin() + f.rows, out_.rows.end());
      // The front of the first row eliminated next, which may lie above the node's parent.
      f.parent = f.below > 0 ? front_of_[out_.rows[f.rows]] : -1;
      if (f.parent < 0) continue;
      next[k] = head[f.parent];
      head[f.parent] = k;
    }
  }

  void link_children() {
    std::vector<int> count(out_.fronts.size() + 1, 0);
    for (const Front& f : out_.fronts)
      if (f.parent >= 0) ++count[f.parent + 1];
    std::partial_sum(count.begin(), count.end(), count.begin());
    out_.children.resize(count.back());
    for (std::size_t k = 0; k < out_.fronts.size(); ++k) {
      out_.fronts[k].children = count[k];
      out_.fronts[k].num_children = 0;
    }
    for (std::size_t k = 0; k < out_.fronts.size(); ++k) {
      if (out_.fronts[k].parent < 0) continue;
      Front& p = out_.fronts[out_.fronts[k].parent];
      out_.children[p.children + p.num_children++] = static_cast<std::int32_t>(k);
    }
  }

  /// Block of a vertex (elimination index) in a front.
  int block_in(const Front& f, int vertex) const {
    if (vertex < f.first + f.pivots) return vertex - f.first;
    const auto begin = out_.rows.begin() + f.rows;
    return f.pivots + static_cast<int>(std::lower_bound(begin, begin + f.below, vertex) - begin);
  }

  void map_rows() {
    out_.map.resize(out_.rows.size());
    for (const Front& f : out_.fronts)
      for (int r = 0; r < f.below; ++r)
        out_.map[f.rows + r] = block_in(out_.fronts[f.parent], out_.rows[f.rows + r]);
  }

  void assign_memory() {
    const int d = input_.block_size;
    const auto aligned = [](std::size_t n) { return (n + 15) / 16 * 16; };
    out_.panel_doubles = out_.schur_doubles = out_.rhs_blocks = out_.tile_flags = 0;
    out_.factor_shared_doubles = out_.solve_rows = out_.solve_panel_doubles = 0;
    out_.tiled_fronts = 0;
    out_.multiply_adds = 0;
    for (Front& f : out_.fronts) {
      const int pivots = f.pivots * d, below = f.below * d, rows = pivots + below + 1;
      f.panel_stride = (rows + 3) / 4 * 4;
      f.schur_stride = (below + 1 + 3) / 4 * 4;
      f.panel = static_cast<std::int64_t>(out_.panel_doubles);
      f.schur = static_cast<std::int64_t>(out_.schur_doubles);
      f.rhs = static_cast<std::int32_t>(out_.rhs_blocks);
      out_.panel_doubles += aligned(static_cast<std::size_t>(f.panel_stride) * pivots);
      out_.schur_doubles += aligned(static_cast<std::size_t>(f.schur_stride) * below);
      out_.rhs_blocks += static_cast<std::size_t>(f.below);
      const std::size_t whole = static_cast<std::size_t>(whole_front_doubles(f, d));
      f.tiled = whole > max_shared_;
      f.tasks = 1;
      if (f.tiled) {
        ++out_.tiled_fronts;
        const int p = count_tiles(f.pivots, tile_blocks(d));
        const int b = count_tiles(f.below, tile_blocks(d));
        f.tasks = b * (b + 1) / 2;
        f.tile_flags = static_cast<std::int32_t>(out_.tile_flags);
        out_.tile_flags += static_cast<std::size_t>(p * (p + b));
      }
      out_.factor_shared_doubles =
          std::max(out_.factor_shared_doubles, f.tiled ? std::size_t{kTileDoubles} : whole);
      out_.solve_rows = std::max(out_.solve_rows, static_cast<std::size_t>(rows));
      out_.solve_panel_doubles =
          std::max(out_.solve_panel_doubles, static_cast<std::size_t>(even(rows)) * pivots);
      for (int j = 0; j < pivots; ++j)
        out_.multiply_adds += 0.5 * static_cast<double>(rows - j) * (rows - j);
    }
  }

  struct Item {
    std::uint64_t place;  ///< column tile, row tile
    std::int32_t column, row, edge;
    bool operator<(const Item& o) const {
      if (place != o.place) return place < o.place;
      if (column != o.column) return column < o.column;
      if (row != o.row) return row < o.row;
      return edge < o.edge;
    }
  };

  int tile_of(const Front& f, int block) const {
    const int per_tile = tile_blocks(input_.block_size);
    return block < f.pivots ? block / per_tile
                            : count_tiles(f.pivots, per_tile) + (block - f.pivots) / per_tile;
  }

  /// Slots in the order in which the fronts read them: first edges between free vertices, by front
  /// and block, then those with one free end, then the rest.
  void assign_slots() {
    const std::vector<int>&ends = *input_.ends, &free_index = *input_.free_index;
    const int num_edges = static_cast<int>(ends.size() / 2);
    std::vector<int> front_begin(out_.fronts.size() + 3, 0), front_of_edge(num_edges);
    const int single = static_cast<int>(out_.fronts.size()), none = single + 1;
    for (int e = 0; e < num_edges; ++e) {
      const int a = free_index[ends[2 * e]], b = free_index[ends[2 * e + 1]];
      front_of_edge[e] = a < 0 && b < 0   ? none
                         : a < 0 || b < 0 ? single
                                          : front_of_[std::min(position_[a], position_[b])];
      ++front_begin[front_of_edge[e] + 1];
    }
    std::partial_sum(front_begin.begin(), front_begin.end(), front_begin.begin());
    std::vector<int> cursor(front_begin.begin(), front_begin.end() - 1);
    std::vector<Item> items(num_edges);
    for (int e = 0; e < num_edges; ++e) {
      Item& item = items[cursor[front_of_edge[e]]++];
      item = {0, 0, 0, e};
      if (front_of_edge[e] >= single) continue;
      const Front& f = out_.fronts[front_of_edge[e]];
      const int a = position_[free_index[ends[2 * e]]], b = position_[free_index[ends[2 * e + 1]]];
      item.column = block_in(f, std::min(a, b));
      item.row = block_in(f, std::max(a, b));
      if (f.tiled)
        item.place = (static_cast<std::uint64_t>(tile_of(f, item.column)) << 32) |
                     static_cast<std::uint64_t>(tile_of(f, item.row));
    }
    out_.num_slots = num_edges;
    out_.pairs.clear();
    places_.clear();
    for (std::size_t k = 0; k < out_.fronts.size(); ++k) {
      Front& f = out_.fronts[k];
      const auto begin = items.begin() + front_begin[k], end = items.begin() + front_begin[k + 1];
      std::sort(begin, end);
      f.pairs_begin = static_cast<std::int32_t>(out_.pairs.size());
      for (auto it = begin; it != end; ++it) {
        const auto slot = static_cast<std::int32_t>(it - items.begin());
        if (it == begin || it->column != (it - 1)->column || it->row != (it - 1)->row) {
          out_.pairs.push_back({it->row, it->column, slot, slot});
          places_.push_back(it->place);
        }
        out_.pairs.back().end = slot + 1;
      }
      f.pairs_end = static_cast<std::int32_t>(out_.pairs.size());
    }
    number_slots(items);
  }

  void number_slots(const std::vector<Item>& items) {
    const std::vector<int>&ends = *input_.ends, &free_index = *input_.free_index;
    const int n = graph_.size(), num_edges = out_.num_slots;
    out_.from.resize(num_edges);
    out_.to.resize(num_edges);
    out_.edge_of_slot.resize(num_edges);
    out_.edges_begin.assign(n + 1, 0);
    const auto vertex = [&](int slot, int end) {
      const int free = free_index[end == 0 ? out_.from[slot] : out_.to[slot]];
      return free < 0 ? -1 : position_[free];
    };
    for (int s = 0; s < num_edges; ++s) {
      out_.edge_of_slot[s] = items[s].edge;
      out_.from[s] = ends[2 * items[s].edge];
      out_.to[s] = ends[2 * items[s].edge + 1];
      for (int end = 0; end < 2; ++end)
        if (const int v = vertex(s, end); v >= 0) ++out_.edges_begin[v + 1];
    }
    std::partial_sum(out_.edges_begin.begin(), out_.edges_begin.end(), out_.edges_begin.begin());
    out_.edges.resize(out_.edges_begin[n]);
    std::vector<int> cursor(out_.edges_begin.begin(), out_.edges_begin.end() - 1);
    for (int s = 0; s < num_edges; ++s)
      for (int end = 0; end < 2; ++end)
        if (const int v = vertex(s, end); v >= 0) out_.edges[cursor[v]++] = 2 * s + end;
  }

  /// Rough time of a front, for the order of tasks only: hand-over, columns, arithmetic.
  double weight(const Front& f) const {
    const double p = f.pivots * input_.block_size, m = p + f.below * input_.block_size;
    return 4 + 0.1 * p + 3e-5 * p * m * m;
  }

  void append_tasks(int index) {
    const Front& f = out_.fronts[index];
    if (!f.tiled) {
      out_.tasks.push_back({index, 0, 0, f.pairs_begin, f.pairs_end});
      return;
    }
    const int per_tile = tile_blocks(input_.block_size);
    const int tiles = count_tiles(f.pivots, per_tile) + count_tiles(f.below, per_tile);
    int pair = f.pairs_begin;
    for (int c = 0; c < tiles; ++c) {
      for (int r = c; r < tiles; ++r) {
        const std::uint64_t place =
            (static_cast<std::uint64_t>(c) << 32) | static_cast<std::uint64_t>(r);
        const int begin = pair;
        while (pair < f.pairs_end && places_[pair] == place) ++pair;
        out_.tasks.push_back({index, r, c, begin, pair});
      }
    }
  }

  /// Longest way to the root first, and downwards the longest way to a leaf: whoever waits, waits
  /// for something that was taken up earlier.
  void order_tasks() {
    const int n = static_cast<int>(out_.fronts.size());
    std::vector<double> up(n), down(n, 0);
    std::vector<int> height(n, 1);
    std::vector<double> columns(n, 0);
    out_.levels = 0;
    out_.critical_columns = 0;
    for (int k = n - 1; k >= 0; --k) {
      const Front& f = out_.fronts[k];
      up[k] = weight(f) + (f.parent < 0 ? 0 : up[f.parent]);
    }
    for (int k = 0; k < n; ++k) {
      const Front& f = out_.fronts[k];
      down[k] += weight(f);
      columns[k] += f.pivots * input_.block_size;
      out_.levels = std::max(out_.levels, height[k]);
      out_.critical_columns = std::max(out_.critical_columns, columns[k]);
      if (f.parent < 0) continue;
      down[f.parent] = std::max(down[f.parent], down[k]);
      height[f.parent] = std::max(height[f.parent], height[k] + 1);
      columns[f.parent] = std::max(columns[f.parent], columns[k]);
    }
    // Fronts take their children in this order, and so the one that is ready last comes last.
    for (const Front& f : out_.fronts) {
      const auto begin = out_.children.begin() + f.children;
      std::stable_sort(begin, begin + f.num_children,
                       [&](int a, int b) { return down[a] < down[b]; });
    }
    std::vector<int> order(n);
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return up[a] > up[b]; });
    out_.tasks.clear();
    for (int k : order) append_tasks(k);
    out_.ascent.assign(order.begin(), order.end());
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return down[a] > down[b]; });
    out_.descent.assign(order.begin(), order.end());
  }

  const ScheduleInput& input_;
  const block::Graph& graph_;
  const Dissection& dissection_;
  std::size_t max_shared_;
  Schedule& out_;
  std::vector<int> position_, front_of_;
  std::vector<std::uint64_t> places_;  // [pairs]
};

}  // namespace

void build_schedule(const ScheduleInput& input, const block::Graph& graph,
                    const Dissection& dissection, std::size_t max_shared_doubles,
                    Schedule& schedule) {
  Builder(input, graph, dissection, max_shared_doubles, schedule).run();
}

}  // namespace fastloop::optimization::device
