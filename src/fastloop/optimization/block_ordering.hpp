#pragma once

#include <vector>

namespace fastloop::optimization::block {

/// Undirected graph without loops and double edges; neighbours ascending.
struct Graph {
  std::vector<int> begin;      ///< [n + 1]
  std::vector<int> neighbour;  ///< [begin[n]]
  int size() const { return static_cast<int>(begin.size()) - 1; }
};

/// Replaces `graph` by the graph on n vertices with the given edges (pairs; equal ends and repetitions are dropped).
void build_graph(int n, const std::vector<int>& edge_ends, Graph& graph);

/// Fill-reducing elimination order: order[k] = vertex eliminated k-th. A few levels of nested dissection give
/// independent parts for the threads, approximate minimum degree orders each part.
std::vector<int> fill_reducing_order(const Graph& graph);

/// Approximate minimum degree alone.
std::vector<int> minimum_degree_order(const Graph& graph);

}  // namespace fastloop::optimization::block
