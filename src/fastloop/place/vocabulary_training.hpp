#pragma once

#include "fastloop/compute/executor.hpp"
#include "fastloop/place/vocabulary.hpp"

namespace fastloop::place {

struct TrainingOptions {
  int branching = 10;       ///< children a node, 2..255
  int levels = 6;           ///< depth of the tree, 1..10
  int min_to_split = 2;     ///< a node with fewer descriptors becomes a word
  int max_iterations = 12;  ///< of k-medians, a node
  std::uint64_t seed = 1;
  void validate() const;  ///< throws InvalidArgument naming the field
};

/// Trains a vocabulary: k-medians with Hamming distance at every node (the median of binary vectors
/// is the majority of each bit), seeded as k-means++; then inverse document frequencies over the
/// same images. The result depends on the images and the options only, not on the executor.
///
/// @param images  descriptors of each training image
/// @throws InvalidArgument without descriptors
VocabularyTree train_vocabulary(const Executor& executor,
                                std::span<const std::vector<Descriptor>> images,
                                const TrainingOptions& options = {});

/// ln(images / images that contain the word) for every leaf; a word in no image counts as in one.
void set_inverse_document_frequencies(VocabularyTree& tree,
                                      std::span<const std::vector<Descriptor>> images);

}  // namespace fastloop::place
