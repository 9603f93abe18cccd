#include "fastloop/place/vocabulary.hpp"

#include <algorithm>
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

FeatureGroups group_keypoints(const std::vector<std::pair<std::uint32_t, std::uint16_t>>& sorted) {
  FeatureGroups groups;
  for (const auto& [node, keypoint] : sorted) {
    if (groups.node.empty() || groups.node.back() != node) {
      groups.node.push_back(node);
      groups.start.push_back(static_cast<std::uint32_t>(groups.indices.size()));
    }
    groups.indices.push_back(keypoint);
  }
  groups.start.push_back(static_cast<std::uint32_t>(groups.indices.size()));
  return groups;
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

std::uint32_t Vocabulary::leaf_of(const Descriptor& descriptor, std::uint32_t* group_node) const {
  std::uint32_t node = 0;
  for (int level = 0; !tree_.is_leaf(node); ++level) {
    const std::uint32_t begin = tree_.first_child[node], end = tree_.first_child[node + 1];
    const std::span<const Descriptor> children(tree_.descriptor.data() + begin, end - begin);
    node = begin + static_cast<std::uint32_t>(nearest_descriptor(descriptor, children).position);
    if (level < kGroupLevel) *group_node = node;
  }
  return node;
}

std::uint32_t Vocabulary::word_of(const Descriptor& descriptor) const {
  std::uint32_t group;
  return word_of_node_[leaf_of(descriptor, &group)];
}

BagOfWords Vocabulary::transform(std::span<const Descriptor> descriptors) const {
  require(descriptors.size() <= 0xffff, "at most 65,535 descriptors");
  std::vector<std::uint32_t> words;
  std::vector<std::pair<std::uint32_t, std::uint16_t>> grouped;
  words.reserve(descriptors.size());
  grouped.reserve(descriptors.size());
  for (std::size_t i = 0; i < descriptors.size(); ++i) {
    std::uint32_t group = 0;
    const std::uint32_t word = word_of_node_[leaf_of(descriptors[i], &group)];
    if (word_weight_[word] == 0) continue;
    words.push_back(word);
    grouped.emplace_back(group, static_cast<std::uint16_t>(i));
  }
  std::sort(words.begin(), words.end());
  std::sort(grouped.begin(), grouped.end());

  BagOfWords bag;
  bag.groups = group_keypoints(grouped);
  double sum = 0;
  for (std::size_t i = 0; i < words.size();) {
    const std::size_t begin = i;
    while (i < words.size() && words[i] == words[begin]) ++i;
    const float weight = static_cast<float>(i - begin) * word_weight_[words[begin]];
    bag.vector.word.push_back(words[begin]);
    bag.vector.weight.push_back(weight);
    sum += weight;
  }
  for (float& w : bag.vector.weight) w = static_cast<float>(w / sum);
  return bag;
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
