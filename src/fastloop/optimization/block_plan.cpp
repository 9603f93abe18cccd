#include "fastloop/optimization/block_plan.hpp"

#include <algorithm>
#include <numeric>
#include <utility>

#include "fastloop/optimization/block_passes.hpp"

namespace fastloop::optimization::block {
namespace {

/// Neighbours by elimination index: of column j those before it in [begin[j], middle[j]), those
/// after it in [middle[j], begin[j + 1]).
struct OrderedGraph {
  std::vector<int> begin, middle, neighbour;
};

OrderedGraph ordered_graph(const Graph& graph, const std::vector<int>& order,
                           const std::vector<int>& position) {
  const int n = graph.size();
  OrderedGraph result;
  result.begin.resize(n + 1);
  result.middle.resize(n);
  result.neighbour.resize(graph.neighbour.size());
  result.begin[0] = 0;
  for (int j = 0; j < n; ++j) {
    const int v = order[j], degree = graph.begin[v + 1] - graph.begin[v];
    int low = result.begin[j], high = low + degree - 1;
    result.begin[j + 1] = low + degree;
    for (int k = graph.begin[v]; k < graph.begin[v + 1]; ++k) {
      // Written to both ends, kept at one: which one cannot be foretold, so no branch.
      const int i = position[graph.neighbour[k]];
      result.neighbour[low] = i;
      if (low < high) result.neighbour[high] = i;
      low += i < j;
      high -= i > j;
    }
    result.middle[j] = low;
  }
  return result;
}

/// Parent of every column in the elimination tree (Liu).
std::vector<int> elimination_tree(const OrderedGraph& graph) {
  const int n = static_cast<int>(graph.middle.size());
  std::vector<int> parent(n, -1), ancestor(n, -1);
  for (int j = 0; j < n; ++j) {
    for (int k = graph.begin[j]; k < graph.middle[j]; ++k) {
      for (int i = graph.neighbour[k]; i != -1 && i < j;) {
        const int next = ancestor[i];
        ancestor[i] = j;
        if (next == -1) parent[i] = j;
        i = next;
      }
    }
  }
  return parent;
}

/// Adds the entries that rows [first, last) have in every column of the factor, below the diagonal:
/// row i has entries on the paths from its neighbours up to i.
void count_rows(const OrderedGraph& graph, const std::vector<int>& parent, int first, int last,
                std::vector<int>& count) {
  std::vector<int> mark(count.size(), -1);
  for (int i = first; i < last; ++i) {
    mark[i] = i;
    for (int k = graph.begin[i]; k < graph.middle[i]; ++k) {
      for (int j = graph.neighbour[k]; mark[j] != i; j = parent[j]) {
        mark[j] = i;
        ++count[j];
      }
    }
  }
}

/// Entries below the diagonal of every column of the factor. Ranges of rows are counted apart.
std::vector<int> column_counts(const OrderedGraph& graph, const std::vector<int>& parent,
                               Passes& passes) {
  const int n = static_cast<int>(parent.size());
  const int parts = passes.threads() > 1 && n > 500 ? 2 * std::min(passes.threads(), 4) : 1;
  std::vector<std::vector<int>> part(static_cast<std::size_t>(parts));
  passes.for_chunks(part.size(), [&](std::size_t p) {
    part[p].assign(n, 0);
    const auto border = [&](std::size_t k) {
      return static_cast<int>(static_cast<std::size_t>(n) * k / part.size());
    };
    count_rows(graph, parent, border(p), border(p + 1), part[p]);
  });
  for (std::size_t p = 1; p < part.size(); ++p)
    for (int j = 0; j < n; ++j) part[0][j] += part[p][j];
  return std::move(part[0]);
}

/// Postorder in which the child with the longest column comes last: it is the one that may join its
/// parent's front.
std::vector<int> postorder(const std::vector<int>& parent, const std::vector<int>& count) {
  const int n = static_cast<int>(parent.size());
  std::vector<int> by_count(n), head(n, -1), next(n, -1), result, stack, begin(n + 1, 0);
  for (int v = 0; v < n; ++v) ++begin[n - 1 - count[v]];  // longest first
  std::exclusive_scan(begin.begin(), begin.end(), begin.begin(), 0);
  for (int v = 0; v < n; ++v) by_count[begin[n - 1 - count[v]]++] = v;
  for (int v : by_count) {
    if (parent[v] < 0) continue;
    next[v] = head[parent[v]];
    head[parent[v]] = v;
  }
  result.reserve(n);
  for (int root = 0; root < n; ++root) {
    if (parent[root] >= 0) continue;
    stack.push_back(root);
    while (!stack.empty()) {
      const int v = stack.back();
      if (head[v] >= 0) {
        const int child = head[v];
        head[v] = next[child];
        stack.push_back(child);
      } else {
        result.push_back(v);
        stack.pop_back();
      }
    }
  }
  return result;
}

struct Candidate {
  int begin, end, rows;
  double zeros;
};

/// May the child join the parent's front? A few explicit zeros buy fewer, larger fronts.
bool worth_merging(const Candidate& child, const Candidate& parent, int block_size, double& zeros) {
  const int width = child.end - child.begin + parent.end - parent.begin;
  const double new_zeros = static_cast<double>(child.end - child.begin) *
                           (parent.end - parent.begin + parent.rows - child.rows);
  zeros = child.zeros + parent.zeros + new_zeros;
  const double total = 0.5 * width * (width + 1) + static_cast<double>(width) * parent.rows;
  const int scalars = width * block_size;
  const double share = zeros / total;
  return new_zeros == 0 || scalars <= 16 || (scalars <= 64 && share < 0.25) ||
         (scalars <= 256 && share < 0.10);
}

/// Supernodes: columns whose structure is that of the next column plus that column, then relaxed
/// merging.
std::vector<Candidate> find_fronts(const std::vector<int>& parent, const std::vector<int>& count,
                                   int block_size) {
  const int n = static_cast<int>(parent.size());
  std::vector<Candidate> fronts;
  for (int begin = 0; begin < n;) {
    int end = begin + 1;
    while (end < n && parent[end - 1] == end && count[end - 1] == count[end] + 1) ++end;
    Candidate current{begin, end, count[end - 1], 0};
    while (!fronts.empty()) {
      const Candidate& child = fronts.back();
      const int up = parent[child.end - 1];
      double zeros;
      if (child.end != current.begin || up < 0 || up >= current.end ||
          !worth_merging(child, current, block_size, zeros))
        break;
      current.begin = child.begin;
      current.zeros = zeros;
      fronts.pop_back();
    }
    fronts.push_back(current);
    begin = end;
  }
  return fronts;
}

void link_children(SymbolicPlan& plan) {
  std::vector<int> cursor(plan.fronts.size() + 1, 0);
  for (const Front& f : plan.fronts)
    if (f.parent >= 0) ++cursor[f.parent + 1];
  std::partial_sum(cursor.begin(), cursor.end(), cursor.begin());
  for (std::size_t k = 0; k < plan.fronts.size(); ++k) {
    plan.fronts[k].children = cursor[k];
    plan.fronts[k].num_children = 0;
  }
  plan.children.resize(cursor.back());
  for (std::size_t k = 0; k < plan.fronts.size(); ++k) {
    const int p = plan.fronts[k].parent;
    if (p < 0) continue;
    Front& parent = plan.fronts[p];
    plan.children[parent.children + parent.num_children++] = static_cast<int>(k);
  }
}

/// Rows of front k: neighbours of its columns and rows of its children, beyond its own columns.
void find_rows_of(std::size_t k, const OrderedGraph& graph, const std::vector<int>& label,
                  const std::vector<int>& post, std::vector<int>& mark, SymbolicPlan& plan) {
  const Front& f = plan.fronts[k];
  const int end = f.first + f.pivots, stamp = static_cast<int>(k);
  int* out = plan.rows.data() + f.rows;
  const auto add = [&](int row) {
    if (row < end || mark[row] == stamp) return;
    mark[row] = stamp;
    *out++ = row;
  };
  for (int j = f.first; j < end; ++j) {
    const int column = post[j];
    for (int e = graph.middle[column]; e < graph.begin[column + 1]; ++e)
      add(label[graph.neighbour[e]]);
  }
  for (int c = 0; c < f.num_children; ++c) {
    const Front& child = plan.fronts[plan.children[f.children + c]];
    for (int r = 0; r < child.below; ++r) add(plan.rows[child.rows + r]);
  }
  std::sort(plan.rows.data() + f.rows, out);
}

/// Ranges of fronts that are whole subtrees, none with much of all rows; fronts above are in none.
std::vector<std::pair<int, int>> independent_ranges(const SymbolicPlan& plan) {
  const int n = static_cast<int>(plan.fronts.size());
  std::vector<int> first(n);  // of the subtree of every front
  for (int k = 0; k < n; ++k) first[k] = k;
  for (int k = 0; k < n; ++k)
    if (const int p = plan.fronts[k].parent; p >= 0) first[p] = std::min(first[p], first[k]);
  const int most = n / 12 + 1;
  std::vector<std::pair<int, int>> ranges;
  for (int k = n - 1; k >= 0;) {
    if (k - first[k] >= most) {
      --k;
      continue;
    }
    // Neighbouring small subtrees share a range.
    if (!ranges.empty() && ranges.back().first == k + 1 && ranges.back().second - first[k] < most) {
      ranges.back().first = first[k];
    } else {
      ranges.emplace_back(first[k], k + 1);
    }
    k = first[k] - 1;
  }
  return ranges;
}

/// Rows of all fronts. Their numbers are known from the column counts, so that subtrees can be
/// treated apart.
void find_rows(const OrderedGraph& graph, const std::vector<int>& label,
               const std::vector<int>& post, Passes& passes, SymbolicPlan& plan) {
  std::size_t total = 0;
  for (Front& f : plan.fronts) {
    f.rows = total;
    total += static_cast<std::size_t>(f.below);
    plan.max_front_blocks = std::max(plan.max_front_blocks, f.pivots + f.below);
  }
  plan.rows.resize(total);
  const std::size_t n = plan.fronts.size();
  std::vector<std::pair<int, int>> ranges;
  if (passes.threads() > 1) ranges = independent_ranges(plan);
  std::vector<std::vector<int>> marks(static_cast<std::size_t>(passes.threads()));
  for (std::vector<int>& mark : marks) mark.assign(post.size(), -1);
  passes.for_chunks(ranges.size(), [&](std::size_t r) {
    std::vector<int>& mark = marks[static_cast<std::size_t>(passes.slot())];
    for (int k = ranges[r].first; k < ranges[r].second; ++k)
      find_rows_of(static_cast<std::size_t>(k), graph, label, post, mark, plan);
  });
  std::size_t k = 0;
  for (auto range = ranges.rbegin(); k < n;) {  // what lies between the ranges
    if (range != ranges.rend() && static_cast<int>(k) == range->first) {
      k = static_cast<std::size_t>(range++->second);
    } else {
      find_rows_of(k++, graph, label, post, marks[0], plan);
    }
  }
}

/// Where the rows of every front lie in its parent.
void map_to_parents(SymbolicPlan& plan) {
  plan.position_in_parent.resize(plan.rows.size());
  plan.runs.clear();
  for (Front& f : plan.fronts) {
    f.runs = plan.runs.size();
    f.num_runs = 0;
    if (f.parent < 0) continue;
    const Front& p = plan.fronts[f.parent];
    const int end = p.first + p.pivots;
    int cursor = 0;
    for (int r = 0; r < f.below; ++r) {
      const int row = plan.rows[f.rows + r];
      int at;
      if (row < end) {
        at = row - p.first;
      } else {
        while (plan.rows[p.rows + cursor] != row) ++cursor;
        at = p.pivots + cursor;
      }
      plan.position_in_parent[f.rows + r] = at;
      if (r > 0 && at == plan.position_in_parent[f.rows + r - 1] + 1) {
        ++plan.runs.back().count;
      } else {
        plan.runs.push_back({r, 1});
        ++f.num_runs;
      }
    }
  }
}

/// Estimated cost of a front: arithmetic, memory traffic, and a constant.
double front_work(const Front& f, int block_size) {
  const double w = f.pivots * block_size, m = w + f.below * block_size;
  return w * m * m + 6 * m * m + 500;
}

/// Cuts the tree of fronts into tasks. A subtree with little work is one task, or part of its
/// parent's task when tiny. A front above joins the task of its only feeding child, so that a chain
/// is one task; where branches meet, a new task starts.
void build_tasks(SymbolicPlan& plan, int block_size) {
  const int n = static_cast<int>(plan.fronts.size());
  std::vector<double> subtree(n, 0);
  plan.work = 0;
  for (int k = 0; k < n; ++k) {
    const double own = front_work(plan.fronts[k], block_size);
    plan.work += own;
    subtree[k] += own;
    if (plan.fronts[k].parent >= 0) subtree[plan.fronts[k].parent] += subtree[k];
  }
  const double heavy = std::max(plan.work / 48, 4e5), tiny = heavy / 8;
  const auto is_heavy = [&](int k) { return subtree[k] > heavy; };
  const auto inherits = [&](int k) {  // from its parent
    const int p = plan.fronts[k].parent;
    return !is_heavy(k) && p >= 0 && (!is_heavy(p) || subtree[k] < tiny);
  };
  plan.tasks.clear();
  for (int k = 0; k < n; ++k) {
    Front& f = plan.fronts[k];
    if (inherits(k)) continue;
    int feeding = -1, num_feeding = 0;
    for (int c = 0; is_heavy(k) && c < f.num_children; ++c) {
      const int child = plan.children[f.children + c];
      if (inherits(child)) continue;
      feeding = plan.fronts[child].task;
      ++num_feeding;
    }
    f.task = num_feeding == 1 ? feeding : static_cast<int>(plan.tasks.size());
    if (num_feeding != 1) plan.tasks.emplace_back();
  }
  for (int k = n - 1; k >= 0; --k)
    if (inherits(k)) plan.fronts[k].task = plan.fronts[plan.fronts[k].parent].task;

  for (const Front& f : plan.fronts) ++plan.tasks[f.task].end;
  std::size_t offset = 0;
  for (Task& t : plan.tasks) {
    t.begin = offset;
    offset += t.end;
    t.end = t.begin;
  }
  plan.task_fronts.resize(n);
  for (int k = 0; k < n; ++k) {
    Task& t = plan.tasks[plan.fronts[k].task];
    plan.task_fronts[t.end++] = k;
  }
  for (std::size_t t = 0; t < plan.tasks.size(); ++t) {
    const Front& root = plan.fronts[plan.task_fronts[plan.tasks[t].end - 1]];
    if (root.parent < 0) continue;
    plan.tasks[t].parent = plan.fronts[root.parent].task;
    ++plan.tasks[plan.tasks[t].parent].num_feeding;
  }
}

/// What scheduling needs: with few threads the long way through the tree must start first.
void weigh_tasks(SymbolicPlan& plan, int block_size) {
  for (Task& t : plan.tasks) {
    double own = 0;
    for (std::size_t i = t.begin; i < t.end; ++i)
      own += front_work(plan.fronts[plan.task_fronts[i]], block_size);
    t.path = own;
    t.below += own;
    if (t.parent < 0) continue;
    double& parent = plan.tasks[t.parent].below;  // so far the costliest of its feeding tasks
    parent = std::max(parent, t.below);
  }
  for (std::size_t t = plan.tasks.size(); t-- > 0;)
    if (plan.tasks[t].parent >= 0) plan.tasks[t].path += plan.tasks[plan.tasks[t].parent].path;
}

/// Memory of one task's update matrices: a front's slot is free again once its parent has read it,
/// and the next front gets the lowest free one, which is the one most likely still in the cache.
class SlotAllocator {
 public:
  std::size_t allocate(std::size_t size) {
    std::size_t at = 0;
    auto it = live_.begin();
    for (; it != live_.end() && it->first < at + size; ++it) at = it->second;
    live_.insert(it, {at, at + size});
    peak_ = std::max(peak_, at + size);
    return at;
  }
  void release(std::size_t at) {
    for (auto it = live_.end(); it != live_.begin();) {
      if ((--it)->first != at) continue;
      live_.erase(it);
      return;
    }
  }
  std::size_t peak() const { return peak_; }

 private:
  std::vector<std::pair<std::size_t, std::size_t>> live_;  // begin, end; ascending
  std::size_t peak_ = 0;
};

std::size_t schur_doubles(const Front& f, int block_size) {
  return static_cast<std::size_t>(f.below) * block_size * f.schur_stride;
}

void assign_memory(SymbolicPlan& plan, int block_size) {
  plan.panel_size = plan.schur_size = plan.scratch_size = plan.rhs_size = 0;
  for (Front& f : plan.fronts) {
    const int pivots = f.pivots * block_size, rows = pivots + f.below * block_size + 1;
    f.panel_stride = (rows + kRowAlign - 1) / kRowAlign * kRowAlign;
    f.schur_first_row = pivots / kRowAlign * kRowAlign;
    f.schur_stride = f.panel_stride - f.schur_first_row;
    f.panel_offset = plan.panel_size;
    plan.panel_size += static_cast<std::size_t>(f.panel_stride) * pivots;
    f.rhs_offset = plan.rhs_size;
    plan.rhs_size += static_cast<std::size_t>(f.below) * block_size;
  }
  for (const Task& t : plan.tasks) {
    SlotAllocator slots;
    for (std::size_t i = t.begin; i < t.end; ++i) {
      Front& f = plan.fronts[plan.task_fronts[i]];
      f.schur_shared = f.parent >= 0 && plan.fronts[f.parent].task != f.task;
      if (f.schur_shared) {
        f.schur_offset = plan.schur_size;
        plan.schur_size += schur_doubles(f, block_size);
      } else {
        f.schur_offset = slots.allocate(schur_doubles(f, block_size));
      }
      for (int c = 0; c < f.num_children; ++c) {
        const Front& child = plan.fronts[plan.children[f.children + c]];
        if (!child.schur_shared && child.below > 0) slots.release(child.schur_offset);
      }
    }
    plan.scratch_size = std::max(plan.scratch_size, slots.peak());
  }
}

}  // namespace

void build_symbolic_plan(const Graph& graph, std::vector<int> order, int block_size, Passes& passes,
                         SymbolicPlan& plan) {
  const int n = graph.size();
  plan.order = std::move(order);
  plan.position.resize(n);
  plan.max_front_blocks = 0;
  for (int k = 0; k < n; ++k) plan.position[plan.order[k]] = k;
  const OrderedGraph ordered = ordered_graph(graph, plan.order, plan.position);
  const std::vector<int> parent = elimination_tree(ordered);
  const std::vector<int> count = column_counts(ordered, parent, passes);

  // Relabel everything in postorder.
  const std::vector<int> post = postorder(parent, count);
  std::vector<int> label(n), new_parent(n), new_count(n), new_order(n);
  for (int k = 0; k < n; ++k) label[post[k]] = k;
  for (int k = 0; k < n; ++k) {
    new_order[k] = plan.order[post[k]];
    new_parent[k] = parent[post[k]] < 0 ? -1 : label[parent[post[k]]];
    new_count[k] = count[post[k]];
  }
  plan.order = std::move(new_order);
  for (int k = 0; k < n; ++k) plan.position[plan.order[k]] = k;

  const std::vector<Candidate> fronts = find_fronts(new_parent, new_count, block_size);
  plan.fronts.assign(fronts.size(), Front());
  plan.front_of.resize(n);
  for (std::size_t k = 0; k < fronts.size(); ++k) {
    plan.fronts[k].first = fronts[k].begin;
    plan.fronts[k].pivots = fronts[k].end - fronts[k].begin;
    plan.fronts[k].below = fronts[k].rows;
    for (int j = fronts[k].begin; j < fronts[k].end; ++j) plan.front_of[j] = static_cast<int>(k);
  }
  for (Front& f : plan.fronts) {
    const int up = new_parent[f.first + f.pivots - 1];
    f.parent = up < 0 ? -1 : plan.front_of[up];
  }
  link_children(plan);
  // Neighbours eliminated later are ancestors in the tree, so that they come later in its postorder
  // as well.
  find_rows(ordered, label, post, passes, plan);
  map_to_parents(plan);
  build_tasks(plan, block_size);
  weigh_tasks(plan, block_size);
  assign_memory(plan, block_size);
}

}  // namespace fastloop::optimization::block
