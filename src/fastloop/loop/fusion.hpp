#pragma once

#include <span>
#include <vector>

#include "fastloop/loop/keyframe_search.hpp"
#include "fastloop/loop/options.hpp"
#include "fastloop/loop/region_match.hpp"
#include "fastloop/map/correction.hpp"

namespace fastloop::loop {

/// What becomes one landmark, and who sees what from now on.
struct Fusion {
  std::vector<map::LandmarkMerge> merges;         ///< ascending loser; winners are not losers
  std::vector<map::NewObservation> observations;  ///< of winners; ascending (keyframe, keypoint)
};

/// Loop fusion: every landmark of the matched side is searched in every moved keyframe. What is found
/// at a keypoint with a landmark makes the two one; at a free keypoint it becomes an observation. All
/// duplicates of all landmarks are joined at once, nearest descriptors first, and never two landmarks
/// that one keyframe sees at different keypoints. Deterministic for any executor.
Fusion fuse_loop(const StepExecutors& executors, const map::Snapshot& snapshot, const LoopOptions& options,
                 const RegionMatch& match, std::span<const MovedKeyframe> moved,
                 const map::LandmarkArrays& cloud);
/// The same with plain sorting and hash maps, one thread: what fuse_loop does with the reference
/// executor.
Fusion fuse_loop_reference(const map::Snapshot& snapshot, const LoopOptions& options,
                           const RegionMatch& match, std::span<const MovedKeyframe> moved,
                           const map::LandmarkArrays& cloud);

}  // namespace fastloop::loop
