#include "fastloop/matching/candidate_lists.hpp"

#include <algorithm>
#include <string>

#include "fastloop/core/error.hpp"

namespace fastloop::matching {
namespace {

void require(bool condition, const char* message) {
  if (!condition) throw InvalidArgument(std::string("descriptor matching: ") + message);
}

bool takes_part(const MatchSide& side, std::size_t keypoint) {
  return side.keypoint_blocked.empty() || !side.keypoint_blocked[keypoint];
}

}  // namespace

void check_side(const MatchSide& side) {
  require(side.features != nullptr, "features are missing");
  const std::size_t n = side.features->size();
  require(side.keypoint_blocked.empty() || side.keypoint_blocked.size() == n,
          "keypoint_blocked must have one entry per keypoint");
  if (!side.groups) return;
  const FeatureGroups& g = *side.groups;
  require(g.start.size() == g.node.size() + 1 || (g.node.empty() && g.start.empty()),
          "groups: start must have one entry more than node");
  require(g.start.empty() || (g.start.front() == 0 && g.start.back() == g.indices.size()),
          "groups: start must span the indices");
  std::uint16_t largest = 0;
  for (const std::uint16_t i : g.indices) largest = std::max(largest, i);
  require(g.indices.empty() || largest < n, "groups: keypoint index out of range");
}

CandidateLists::CandidateLists(const MatchSide& first, const MatchSide& second) {
  check_side(first);
  check_side(second);
  range_.resize(first.features->size());
  if (first.groups && second.groups)
    compare_groups(first, second);
  else
    compare_all(first, second);
}

void CandidateLists::compare_all(const MatchSide& first, const MatchSide& second) {
  for (std::size_t k = 0; k < second.features->size(); ++k)
    if (takes_part(second, k)) indices_.push_back(static_cast<std::uint16_t>(k));
  const Range all{0, static_cast<std::uint32_t>(indices_.size())};
  for (std::size_t k = 0; k < range_.size(); ++k)
    if (takes_part(first, k)) range_[k] = all;
}

void CandidateLists::compare_groups(const MatchSide& first, const MatchSide& second) {
  const FeatureGroups &a = *first.groups, &b = *second.groups;
  indices_.resize(b.indices.size());
  std::uint16_t* next = indices_.data();
  std::size_t j = 0;
  for (std::size_t i = 0; i < a.node.size(); ++i) {
    while (j < b.node.size() && b.node[j] < a.node[i]) ++j;
    if (j == b.node.size()) break;
    if (b.node[j] != a.node[i]) continue;
    Range range;
    range.begin = static_cast<std::uint32_t>(next - indices_.data());
    for (std::uint32_t k = b.start[j]; k < b.start[j + 1]; ++k) {
      *next = b.indices[k];  // kept or written over: no branch to guess
      next += takes_part(second, b.indices[k]);
    }
    range.end = static_cast<std::uint32_t>(next - indices_.data());
    for (std::uint32_t k = a.start[i]; k < a.start[i + 1]; ++k)
      if (takes_part(first, a.indices[k])) range_[a.indices[k]] = range;
    ++j;  // a node is named once
  }
}

}  // namespace fastloop::matching
