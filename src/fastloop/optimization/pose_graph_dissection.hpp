#pragma once

#include <limits>
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
/// the trees of minimum degree can be as high as the chain is long. Pieces that have more than
/// `max_front` vertices together with their neighbours outside are cut further where that is
/// possible. The result depends on the graph alone.
Dissection dissect(const block::Graph& graph, int leaf_size,
                   int max_front = std::numeric_limits<int>::max());

/// Fits an older dissection to a graph that has grown or changed: `node_of` [n] tells the old node
/// of every vertex, -1 for new ones, `parent` the old forest in postorder. New vertices are
/// dissected among themselves and hung below what they touch; where an edge joins two branches, one
/// end moves up to where they meet. False where that cannot be.
bool extend_dissection(const block::Graph& graph, const std::vector<int>& node_of,
                       const std::vector<int>& parent, int leaf_size, Dissection& result);

}  // namespace fastloop::optimization::device
