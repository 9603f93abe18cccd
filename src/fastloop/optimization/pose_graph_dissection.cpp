#include "fastloop/optimization/pose_graph_dissection.hpp"

#include <algorithm>
#include <cstdlib>
#include <limits>

namespace fastloop::optimization::device {
namespace {

/// Smallest set of vertices that touches every edge between two sets (Koenig's theorem).
class VertexCover {
 public:
  explicit VertexCover(int n) : match_(n, -1), seen_(n, 0) {}

  /// `neighbours(v, f)` calls f with the neighbours on the other side of a vertex on the left,
  /// until f returns true.
  template <class Neighbours>
  void find(const std::vector<int>& left, const Neighbours& neighbours, std::vector<int>& cover) {
    for (int v : left) {
      ++stamp_;
      augment(v, neighbours);
    }
    ++stamp_;
    reached_.clear();
    for (int v : left)
      if (match_[v] < 0) reach(v, neighbours);
    cover.clear();
    for (int v : left)
      if (match_[v] >= 0) cover.push_back(seen_[match_[v]] == stamp_ ? match_[v] : v);
    for (int v : left) {
      if (match_[v] >= 0) match_[match_[v]] = -1;
      match_[v] = -1;
    }
  }

 private:
  template <class Neighbours>
  bool augment(int v, const Neighbours& neighbours) {
    return neighbours(v, [&](int u) {
      if (seen_[u] == stamp_) return false;
      seen_[u] = stamp_;
      if (match_[u] >= 0 && !augment(match_[u], neighbours)) return false;
      match_[u] = v;
      match_[v] = u;
      return true;
    });
  }

  template <class Neighbours>
  void reach(int v, const Neighbours& neighbours) {
    neighbours(v, [&](int u) {
      if (seen_[u] == stamp_) return false;
      seen_[u] = stamp_;
      reach(match_[u], neighbours);  // matched, or the matching could be larger
      return false;
    });
  }

  std::vector<int> match_, reached_;
  std::vector<int> seen_;
  int stamp_ = 0;
};

struct Node {
  std::vector<int> vertices;
  int parent;
};

/// Children before parents, in the order in which they stand; nodes without vertices are left out
/// and their children go to their parents.
Dissection in_postorder(std::vector<Node>& nodes) {
  const int n = static_cast<int>(nodes.size());
  for (Node& node : nodes)
    while (node.parent >= 0 && nodes[node.parent].vertices.empty())
      node.parent = nodes[node.parent].parent;
  std::vector<int> head(n + 1, -1), next(n, -1);
  for (int k = n - 1; k >= 0; --k) {
    const int p = nodes[k].parent < 0 ? n : nodes[k].parent;
    next[k] = head[p];
    head[p] = k;
  }
  Dissection result;
  result.begin.push_back(0);
  std::vector<int> label(n, -1), stack, order;
  for (int root = head[n]; root >= 0; root = next[root]) {
    stack.push_back(root);
    while (!stack.empty()) {
      const int k = stack.back();
      if (const int child = head[k]; child >= 0) {
        head[k] = next[child];
        stack.push_back(child);
        continue;
      }
      stack.pop_back();
      if (nodes[k].vertices.empty()) continue;
      label[k] = static_cast<int>(order.size());
      order.push_back(k);
    }
  }
  for (int k : order) {
    const int p = nodes[k].parent;
    result.parent.push_back(p < 0 ? -1 : label[p]);
    result.vertices.insert(result.vertices.end(), nodes[k].vertices.begin(),
                           nodes[k].vertices.end());
    result.begin.push_back(static_cast<int>(result.vertices.size()));
  }
  return result;
}

class Dissector {
 public:
  Dissector(const block::Graph& graph, int leaf_size, int max_front)
      : graph_(graph),
        leaf_size_(leaf_size),
        max_front_(max_front),
        region_(graph.size(), -1),
        level_(graph.size(), -1),
        cover_(graph.size()),
        in_cover_(graph.size(), 0),
        counted_(graph.size(), 0) {}

  Dissection run() {
    std::vector<int> all(graph_.size());
    for (int v = 0; v < graph_.size(); ++v) all[v] = v;
    split_components(std::move(all), -1);
    while (!open_.empty()) {
      Piece piece = std::move(open_.back());
      open_.pop_back();
      cut(piece);
    }
    return in_postorder(nodes_);
  }

 private:
  struct Piece {
    std::vector<int> vertices;
    int parent;
  };
  /// Levels of a breadth-first search within the region of `start`.
  void search(int start) {
    queue_.clear();
    level_begin_.clear();
    queue_.push_back(start);
    const int region = region_[start];
    region_[start] = -2 - region;  // visited
    std::size_t head = 0;
    while (head < queue_.size()) {
      const std::size_t end = queue_.size();
      level_begin_.push_back(static_cast<int>(head));
      for (; head < end; ++head) {
        const int v = queue_[head];
        for (int k = graph_.begin[v]; k < graph_.begin[v + 1]; ++k) {
          const int u = graph_.neighbour[k];
          if (region_[u] != region) continue;
          region_[u] = -2 - region;
          queue_.push_back(u);
        }
      }
    }
    level_begin_.push_back(static_cast<int>(queue_.size()));
    for (int v : queue_) region_[v] = region;
  }

  void split_components(std::vector<int> vertices, int parent) {
    if (vertices.empty()) return;
    std::sort(vertices.begin(), vertices.end());
    const int region = next_region_++;
    for (int v : vertices) region_[v] = region;
    for (int v : vertices) {
      if (region_[v] != region) continue;
      search(v);
      const int own = next_region_++;
      for (int u : queue_) region_[u] = own;
      open_.push_back({queue_, parent});
    }
  }

  int add_node(std::vector<int> vertices, int parent) {
    std::sort(vertices.begin(), vertices.end());
    nodes_.push_back({std::move(vertices), parent});
    return static_cast<int>(nodes_.size()) - 1;
  }

  /// A connected piece: either a leaf or a separator and what it separates.
  void cut(Piece& piece) {
    const int size = static_cast<int>(piece.vertices.size());
    if (size <= leaf_size_ && size + outside(piece.vertices) <= max_front_) {
      add_node(std::move(piece.vertices), piece.parent);
      return;
    }
    search(piece.vertices.back());  // the last of the search from the smallest vertex: far out
    if (level_begin_.size() < 4) {
      add_node(std::move(piece.vertices), piece.parent);
      return;
    }
    const int border = best_border(size);
    find_separator(border);
    std::vector<int> low, high, separator = separator_;
    for (int v : separator) in_cover_[v] = 1;
    for (int k = 0; k < size; ++k)
      if (!in_cover_[queue_[k]]) (k < level_begin_[border] ? low : high).push_back(queue_[k]);
    for (int v : separator) in_cover_[v] = 0;
    const int node = add_node(std::move(separator), piece.parent);
    split_components(std::move(low), node);
    split_components(std::move(high), node);
  }

  /// Neighbours of a piece outside it.
  int outside(const std::vector<int>& vertices) {
    int count = 0;
    ++stamp_;
    for (int v : vertices) {
      for (int k = graph_.begin[v]; k < graph_.begin[v + 1]; ++k) {
        const int u = graph_.neighbour[k];
        if (region_[u] == region_[v] || counted_[u] == stamp_) continue;
        counted_[u] = stamp_;
        ++count;
      }
    }
    return count;
  }

  /// The first level of the upper part: narrow and near the middle.
  int best_border(int size) const {
    const int levels = static_cast<int>(level_begin_.size()) - 1;
    int best = 1;
    double best_score = std::numeric_limits<double>::max();
    for (int l = 1; l < levels; ++l) {
      const double width =
          std::min(level_begin_[l] - level_begin_[l - 1], level_begin_[l + 1] - level_begin_[l]);
      const double balance = std::abs(2.0 * level_begin_[l] / size - 1);
      const double score = (width + 1) * (1 + balance) / std::max(1e-9, 1 - balance * balance);
      if (score >= best_score) continue;
      best_score = score;
      best = l;
    }
    return best;
  }

  /// Smallest set that touches all edges between level border - 1 and level border.
  void find_separator(int border) {
    for (int k = level_begin_[border]; k < level_begin_[border + 1]; ++k)
      level_[queue_[k]] = border;
    const std::vector<int> left(queue_.begin() + level_begin_[border - 1],
                                queue_.begin() + level_begin_[border]);
    cover_.find(
        left,
        [&](int v, auto f) {
          for (int k = graph_.begin[v]; k < graph_.begin[v + 1]; ++k) {
            const int u = graph_.neighbour[k];
            if (level_[u] == border && region_[u] == region_[v] && f(u)) return true;
          }
          return false;
        },
        separator_);
    for (int k = level_begin_[border]; k < level_begin_[border + 1]; ++k) level_[queue_[k]] = -1;
  }

  const block::Graph& graph_;
  int leaf_size_, max_front_;
  std::vector<int> region_, level_, queue_, level_begin_, separator_;
  VertexCover cover_;
  std::vector<char> in_cover_;
  int next_region_ = 0;
  std::vector<int> counted_;
  int stamp_ = 0;
  std::vector<Piece> open_;
  std::vector<Node> nodes_;
};

}  // namespace

Dissection dissect(const block::Graph& graph, int leaf_size, int max_front) {
  return Dissector(graph, leaf_size, max_front).run();
}

bool extend_dissection(const block::Graph& graph, const std::vector<int>& node_of,
                       const std::vector<int>& parent, int leaf_size, Dissection& result) {
  const int n = graph.size();
  std::vector<int> where = node_of, up = parent, label(n, -1), fresh;
  for (int v = 0; v < n; ++v)
    if (where[v] < 0) {
      label[v] = static_cast<int>(fresh.size());
      fresh.push_back(v);
    }
  std::vector<int> ends;
  for (int v : fresh)
    for (int k = graph.begin[v]; k < graph.begin[v + 1]; ++k)
      if (const int u = graph.neighbour[k]; u > v && label[u] >= 0)
        ends.insert(ends.end(), {label[v], label[u]});
  block::Graph part;
  block::build_graph(static_cast<int>(fresh.size()), ends, part);
  const Dissection added = dissect(part, leaf_size);
  const int old = static_cast<int>(parent.size());
  std::vector<int> below(added.size(), -1);  // lowest old node that a new tree touches
  for (int k = 0; k < added.size(); ++k) {
    for (int i = added.begin[k]; i < added.begin[k + 1]; ++i) {
      const int v = fresh[added.vertices[i]];
      where[v] = old + k;
      for (int e = graph.begin[v]; e < graph.begin[v + 1]; ++e)
        if (const int node = node_of[graph.neighbour[e]]; node >= 0)
          below[k] = below[k] < 0 ? node : std::min(below[k], node);
    }
    if (added.parent[k] < 0) {
      up.push_back(below[k]);
    } else {
      int& above = below[added.parent[k]];
      if (below[k] >= 0) above = above < 0 ? below[k] : std::min(above, below[k]);
      up.push_back(old + added.parent[k]);
    }
  }
  // Depths, so that two ways up can be walked side by side.
  const int nodes = static_cast<int>(up.size());
  std::vector<int> depth(nodes, 0);
  for (int k = old - 1; k >= 0; --k) depth[k] = up[k] < 0 ? 0 : depth[up[k]] + 1;
  for (int k = nodes - 1; k >= old; --k) depth[k] = up[k] < 0 ? 0 : depth[up[k]] + 1;
  for (int v = 0; v < n; ++v) {
    for (int e = graph.begin[v]; e < graph.begin[v + 1]; ++e) {
      const int u = graph.neighbour[e];
      if (u > v || where[u] == where[v]) continue;
      int a = where[u], b = where[v];
      while (a != b && a >= 0 && b >= 0) {
        if (depth[a] > depth[b]) {
          a = up[a];
        } else if (depth[b] > depth[a]) {
          b = up[b];
        } else {
          a = up[a];
          b = up[b];
        }
      }
      if (a < 0 || b < 0) return false;  // two trees become one
      if (a != where[u] && a != where[v]) where[u] = a;
    }
  }
  std::vector<Node> forest(nodes);
  for (int k = 0; k < nodes; ++k) forest[k].parent = up[k];
  for (int v = 0; v < n; ++v) forest[where[v]].vertices.push_back(v);
  result = in_postorder(forest);
  return true;
}

}  // namespace fastloop::optimization::device
