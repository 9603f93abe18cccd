#pragma once

#include <vector>

#include "fastloop/optimization/block_ordering.hpp"

namespace fastloop::optimization::device {

/// Nested dissection: a forest whose nodes hold disjoint sets of vertices, all vertices together.
/// Two neighbours in the graph lie in the same node or in two of which one is above the other.
/// Nodes are in postorder, children before parents.
struct Dissection {
  std::vector<int> parent;    ///< [nodes] or -1
  std::vector<int> begin;     ///< [nodes + 1] into vertices
  std::vector<int> vertices;  ///< [n]
  int size() const { return static_cast<int>(parent.size()); }
};

/// Cuts the graph at the narrow places of breadth-first levels until pieces have at most
/// `leaf_size` vertices. On a chain this is cyclic reduction: a tree of logarithmic height, where
/// the trees of minimum degree can be as high as the chain is long. The result depends on the graph
/// alone.
Dissection dissect(const block::Graph& graph, int leaf_size);

}  // namespace fastloop::optimization::device
