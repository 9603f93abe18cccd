#include "fastloop/place/vocabulary.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <string>

#include "fastloop/core/error.hpp"
#include "fastloop/features/hamming.hpp"

namespace fastloop::place {
namespace {

void require(bool condition, const char* message) {
  if (!condition) throw InvalidArgument(std::string("vocabulary: ") + message);
}

/// In breadth-first order every node but the root is the child of exactly one earlier node.
void check_tree(const VocabularyTree& tree) {
  const std::size_t n = tree.size();
  require(n >= 2, "a tree needs a root and at least one word");
  require(tree.first_child.size() == n + 1 && tree.weight.size() == n, "arrays differ in length");
  require(tree.first_child[0] == 1 && tree.first_child[n] == n,
          "nodes are not in breadth-first order");
  for (std::size_t i = 0; i < n; ++i) {
    require(tree.first_child[i] <= tree.first_child[i + 1] &&
                (tree.is_leaf(i) || tree.first_child[i] > i),
            "nodes are not in breadth-first order");
    require(std::isfinite(tree.weight[i]) && tree.weight[i] >= 0,
            "weights must be finite and >= 0");
  }
}

/// Sorts by the bits from `shift` on, keeping the order of equals: a counting sort for each ten bits,
/// several times as fast as comparing for a few thousand keys.
void sort_by_bits(std::vector<std::uint64_t>& keys, int shift) {
  constexpr int kBits = 10;
  std::uint64_t used = 0;
  for (const std::uint64_t key : keys) used |= key >> shift;
  std::vector<std::uint64_t> sorted(keys.size());
  for (; used != 0; used >>= kBits, shift += kBits) {
    const auto digit = [shift](std::uint64_t key) { return key >> shift & ((1u << kBits) - 1u); };
    std::array<std::uint32_t, (1 << kBits) + 1> next{};
    for (const std::uint64_t key : keys) ++next[digit(key) + 1];
    for (std::size_t d = 1; d < next.size(); ++d) next[d] += next[d - 1];
    for (const std::uint64_t key : keys) sorted[next[digit(key)]++] = key;
    keys.swap(sorted);
  }
}

/// @param sorted  node << 16 | keypoint
FeatureGroups group_keypoints(const std::vector<std::uint64_t>& sorted) {
  FeatureGroups groups;
  for (const std::uint64_t key : sorted) {
    const auto node = static_cast<std::uint32_t>(key >> 16);
    const auto keypoint = static_cast<std::uint16_t>(key & 0xffff);
    if (groups.node.empty() || groups.node.back() != node) {
      groups.node.push_back(node);
      groups.start.push_back(static_cast<std::uint32_t>(groups.indices.size()));
    }
    groups.indices.push_back(keypoint);
  }
  groups.start.push_back(static_cast<std::uint32_t>(groups.indices.size()));
  return groups;
}

/// The lower levels of a tree are larger than the caches: the children of all are on their way before
/// the first are compared.
void ask_ahead(const VocabularyTree& tree, std::span<const DescriptorRun> children) {
  constexpr std::uint32_t kDescriptorsOfALine = 64 / sizeof(Descriptor);
  for (const DescriptorRun& run : children)
    for (std::uint32_t n = run.begin; n < run.end; n += kDescriptorsOfALine)
      __builtin_prefetch(&tree.descriptor[n]);
}

}  // namespace

Vocabulary::Vocabulary(VocabularyTree tree) : tree_(std::move(tree)) {
  check_tree(tree_);
  word_of_node_.resize(tree_.size());
  for (std::size_t n = 1; n < tree_.size(); ++n) {
    if (!tree_.is_leaf(n)) continue;
    word_of_node_[n] = static_cast<std::uint32_t>(word_weight_.size());
    word_weight_.push_back(tree_.weight[n]);
  }
}

void Vocabulary::descend(std::span<const Descriptor> descriptors, bool reference,
                         std::uint32_t* leaf, std::uint32_t* group_node) const {
  // Some descriptors go down together, level by level.
  constexpr std::size_t kTogether = 16;
  std::array<DescriptorRun, kTogether> children;
  for (std::size_t first = 0; first < descriptors.size(); first += kTogether) {
    const auto some = descriptors.subspan(first, std::min(kTogether, descriptors.size() - first));
    std::uint32_t *node = leaf + first, *group = group_node + first;
    std::fill_n(node, some.size(), 0u);
    std::fill_n(group, some.size(), 0u);
    for (int level = 0;; ++level) {
      bool inside = false;
      for (std::size_t i = 0; i < some.size(); ++i) {
        children[i] = {tree_.first_child[node[i]], tree_.first_child[node[i] + 1]};
        inside |= children[i].begin < children[i].end;
      }
      if (!inside) break;
      if (!reference) ask_ahead(tree_, std::span(children).first(some.size()));
      const std::span<const DescriptorRun> runs(children.data(), some.size());
      reference ? reference::nearest_in_runs(some, tree_.descriptor.data(), runs, node)
                : nearest_in_runs(some, tree_.descriptor.data(), runs, node);
      if (level < kGroupLevel) std::copy_n(node, some.size(), group);
    }
  }
}

std::uint32_t Vocabulary::word_of(const Descriptor& descriptor) const {
  std::uint32_t leaf, group;
  descend({&descriptor, 1}, false, &leaf, &group);
  return word_of_node_[leaf];
}

BagOfWords Vocabulary::transform(std::span<const Descriptor> descriptors,
                                 const Executor& executor) const {
  require(descriptors.size() <= 0xffff, "at most 65,535 descriptors");
  const bool reference = executor.kind() == Executor::Kind::kReference;
  std::vector<std::uint32_t> leaf(descriptors.size()), group_node(descriptors.size());
  executor.for_ranges(descriptors.size(), 64, [&](std::size_t begin, std::size_t end) {
    descend(descriptors.subspan(begin, end - begin), reference, leaf.data() + begin,
            group_node.data() + begin);
  });
  BagOfWords bag;
  executor.for_short_passes().for_ranges(2, 1, [&](std::size_t begin, std::size_t end) {
    for (; begin < end; ++begin)
      if (begin == 0)
        bag.vector = weigh(leaf);
      else
        bag.groups = group(leaf, group_node);
  });
  return bag;
}

BowVector Vocabulary::weigh(std::span<const std::uint32_t> leaf) const {
  std::vector<std::uint64_t> words;
  words.reserve(leaf.size());
  for (const std::uint32_t node : leaf)
    if (const std::uint32_t word = word_of_node_[node]; word_weight_[word] != 0)
      words.push_back(word);
  sort_by_bits(words, 0);
  BowVector vector;
  double sum = 0;
  for (std::size_t i = 0; i < words.size();) {
    const std::size_t begin = i;
    while (i < words.size() && words[i] == words[begin]) ++i;
    const float weight = static_cast<float>(i - begin) * word_weight_[words[begin]];
    vector.word.push_back(static_cast<std::uint32_t>(words[begin]));
    vector.weight.push_back(weight);
    sum += weight;
  }
  for (float& w : vector.weight) w = static_cast<float>(w / sum);
  return vector;
}

FeatureGroups Vocabulary::group(std::span<const std::uint32_t> leaf,
                                std::span<const std::uint32_t> group_node) const {
  std::vector<std::uint64_t> grouped;  // group, then keypoint
  grouped.reserve(leaf.size());
  for (std::size_t i = 0; i < leaf.size(); ++i)
    if (word_weight_[word_of_node_[leaf[i]]] != 0)
      grouped.push_back(std::uint64_t{group_node[i]} << 16 | i);
  sort_by_bits(grouped, 16);
  return group_keypoints(grouped);
}

float l1_score(const BowVector& a, const BowVector& b) {
  float score = 0;
  for (std::size_t i = 0, j = 0; i < a.size() && j < b.size();) {
    if (a.word[i] == b.word[j]) {
      score += std::min(a.weight[i], b.weight[j]);
      ++i, ++j;
    } else if (a.word[i] < b.word[j]) {
      ++i;
    } else {
      ++j;
    }
  }
  return score;
}

}  // namespace fastloop::place
