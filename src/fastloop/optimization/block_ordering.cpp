#include "fastloop/optimization/block_ordering.hpp"

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>
#include <algorithm>

namespace fastloop::optimization::block {

void build_graph(int n, const std::vector<int>& ends, Graph& graph) {
  graph.begin.assign(n + 1, 0);
  for (std::size_t k = 0; k < ends.size(); k += 2) {
    if (ends[k] == ends[k + 1]) continue;
    ++graph.begin[ends[k] + 1];
    ++graph.begin[ends[k + 1] + 1];
  }
  for (int i = 0; i < n; ++i) graph.begin[i + 1] += graph.begin[i];
  // Unsorted lists first; handing every vertex, in order, to its neighbours then gives sorted ones.
  std::vector<int> cursor(graph.begin.begin(), graph.begin.end() - 1), unsorted(graph.begin[n]);
  for (std::size_t k = 0; k < ends.size(); k += 2) {
    const int a = ends[k], b = ends[k + 1];
    if (a == b) continue;
    unsorted[cursor[a]++] = b;
    unsorted[cursor[b]++] = a;
  }
  graph.neighbour.resize(graph.begin[n]);
  std::copy(graph.begin.begin(), graph.begin.end() - 1, cursor.begin());
  for (int v = 0; v < n; ++v)
    for (int k = graph.begin[v]; k < graph.begin[v + 1]; ++k)
      graph.neighbour[cursor[unsorted[k]]++] = v;
  int out = 0;
  for (int i = 0; i < n; ++i) {
    const auto first = graph.neighbour.begin() + graph.begin[i];
    const auto last = graph.neighbour.begin() + graph.begin[i + 1];
    graph.begin[i] = out;
    for (auto it = first; it != last; ++it)
      if (it == first || *it != *(it - 1)) graph.neighbour[out++] = *it;
  }
  graph.begin[n] = out;
  graph.neighbour.resize(out);
}

std::vector<int> minimum_degree_order(const Graph& graph) {
  const int n = graph.size();
  // Only the pattern counts; one byte a value keeps it small. Eigen takes a vertex without a
  // diagonal entry for dense and puts it last, so the diagonal must be there. Its AMDOrdering would
  // copy the pattern twice; what it calls takes the whole pattern, and needs room to grow.
  using Pattern = Eigen::SparseMatrix<signed char, Eigen::ColMajor, int>;
  Pattern pattern(n, n);
  const auto entries = static_cast<Eigen::Index>(graph.neighbour.size()) + n;
  pattern.resizeNonZeros(entries + entries / 5 + 2 * n);
  pattern.resizeNonZeros(entries);
  int* index = pattern.innerIndexPtr();
  for (int v = 0; v < n; ++v) {
    pattern.outerIndexPtr()[v] = static_cast<int>(index - pattern.innerIndexPtr());
    *index++ = v;
    index = std::copy(graph.neighbour.begin() + graph.begin[v],
                      graph.neighbour.begin() + graph.begin[v + 1], index);
  }
  pattern.outerIndexPtr()[n] = static_cast<int>(entries);
  Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, int> permutation;
  Eigen::internal::minimum_degree_ordering(pattern, permutation);
  return {permutation.indices().data(), permutation.indices().data() + n};
}

}  // namespace fastloop::optimization::block
