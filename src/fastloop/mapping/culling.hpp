#pragma once

#include <vector>

#include "fastloop/map/map.hpp"
#include "fastloop/mapping/options.hpp"

namespace fastloop::mapping {

/// Watches young landmarks: one that is rarely found where it should be seen, or that no second
/// keyframe has seen soon after its creation, is removed.
class LandmarkProbation {
 public:
  void add(const std::vector<LandmarkId>& created) {
    young_.insert(young_.end(), created.begin(), created.end());
  }
  void review(map::Map& map, KeyframeId newest);

 private:
  std::vector<LandmarkId> young_;
};

/// Removes neighbours of `keyframe` whose landmarks are nearly all seen by three other keyframes at
/// the same or a finer scale. Returns how many were removed.
int cull_keyframes(map::Map& map, KeyframeId keyframe, bool inertial,
                   const MappingOptions& options);

}  // namespace fastloop::mapping
