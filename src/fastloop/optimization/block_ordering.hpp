#pragma once

#include <vector>

namespace fastloop::optimization::block {

/// Undirected graph without loops and double edges; neighbours ascending.
struct Graph {
  std::vector<int> begin;      ///< [n + 1]
  std::vector<int> neighbour;  ///< [begin[n]]
  int size() const { return static_cast<int>(begin.size()) - 1; }
};

/// Replaces `graph` by the graph on n vertices with the given edges (pairs; equal ends and
/// repetitions are dropped).
void build_graph(int n, const std::vector<int>& edge_ends, Graph& graph);

/// Fill-reducing elimination order by approximate minimum degree: order[k] = vertex eliminated
/// k-th.
std::vector<int> minimum_degree_order(const Graph& graph);

}  // namespace fastloop::optimization::block
