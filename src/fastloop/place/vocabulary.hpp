#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/compute/executor.hpp"
#include "fastloop/features/feature_set.hpp"
#include "fastloop/matching/bag_of_words.hpp"

namespace fastloop::place {

/// A vocabulary as plain data. Nodes in breadth-first order, node 0 is the root: the children of
/// node n are [first_child[n], first_child[n + 1]). A node without children is a leaf, that is a
/// word.
struct VocabularyTree {
  int branching = 0;                       ///< largest number of children
  int levels = 0;                          ///< largest depth of a leaf; the root has depth 0
  std::vector<Descriptor> descriptor;      ///< [nodes]; the root's is unused
  std::vector<std::uint32_t> first_child;  ///< [nodes + 1]
  std::vector<float> weight;  ///< [nodes] inverse document frequency of leaves, >= 0; 0 inside
  bool operator==(const VocabularyTree&) const = default;

  std::size_t size() const { return descriptor.size(); }
  bool is_leaf(std::size_t node) const { return first_child[node] == first_child[node + 1]; }
};

/// An image in terms of a vocabulary.
struct BagOfWords {
  BowVector vector;
  FeatureGroups groups;  ///< by the node at Vocabulary::kGroupLevel on the way to the word
};

/// Hierarchical vocabulary of binary descriptors with tf-idf weights (Nister and Stewenius, CVPR
/// 2006; Galvez-Lopez and Tardos, T-RO 2012). Immutable; safe to share between threads.
class Vocabulary {
 public:
  /// Tree level whose nodes group the keypoints for matching: 100 groups for ten children a node.
  static constexpr int kGroupLevel = 2;

  /// @throws InvalidArgument when the tree is not one (see VocabularyTree) or has no words.
  explicit Vocabulary(VocabularyTree tree);

  const VocabularyTree& tree() const { return tree_; }
  std::size_t num_words() const { return word_weight_.size(); }

  /// Word of a descriptor: at every node the nearest child (ties: the lower one).
  std::uint32_t word_of(const Descriptor& descriptor) const;

  /// Term frequency times inverse document frequency, L1-normalised. Words of weight zero are left
  /// out, and so are their keypoints in the groups. At most 65,535 descriptors.
  /// The result does not depend on the executor; the reference descends with scalar distances.
  BagOfWords transform(std::span<const Descriptor> descriptors,
                       const Executor& executor = Executor::cpu()) const;

 private:
  /// Leaves, and nodes at kGroupLevel on the way (or above, where that is the leaf).
  void descend(std::span<const Descriptor> descriptors, bool reference, std::uint32_t* leaf,
               std::uint32_t* group_node) const;
  BowVector weigh(std::span<const std::uint32_t> leaf) const;
  FeatureGroups group(std::span<const std::uint32_t> leaf,
                      std::span<const std::uint32_t> group_node) const;

  VocabularyTree tree_;
  std::vector<std::uint32_t> word_of_node_;  ///< [nodes] of leaves, in node order
  std::vector<float> word_weight_;           ///< [words]
};

/// Similarity of two images: 1 - |a - b|_1 / 2, which is the sum of the smaller weights; 0 (no word
/// in common) to 1.
float l1_score(const BowVector& a, const BowVector& b);

}  // namespace fastloop::place
