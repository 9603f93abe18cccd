#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/features/feature_set.hpp"

namespace fastloop {

/// Keypoints of an image grouped by vocabulary node (CSR): the keypoints of `node[g]` are
/// `indices[start[g] .. start[g + 1])`. Nodes ascend, and so do indices within a group. Keypoints
/// whose word the vocabulary does not weigh belong to no group.
struct FeatureGroups {
  std::vector<std::uint32_t> node;
  std::vector<std::uint32_t> start;  ///< [node.size() + 1]
  std::vector<std::uint16_t> indices;
  ContentId id;
  bool operator==(const FeatureGroups&) const = default;
};

/// An image as a sparse vector over the words of a vocabulary, L1-normalised. Words ascend.
struct BowVector {
  std::vector<std::uint32_t> word;
  std::vector<float> weight;  ///< [word.size()] > 0, sum 1
  std::size_t size() const { return word.size(); }
  bool operator==(const BowVector&) const = default;
};

}  // namespace fastloop
