#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/matching/match_lists.hpp"
#include "fastloop/matching/projection_math.hpp"
#include "fastloop/matching/resident_store.hpp"

namespace fastloop::matching {

/// Landmarks of some targets of a search on the device.
struct LandmarksToSearch {
  LandmarkArrays arrays;  ///< on the host
  std::size_t count = 0;
  const ResidentLandmarks* resident = nullptr;  ///< null: copied with the call
};

struct TargetToSearch {
  TargetView view;                       ///< pointers on the host
  const FeatureSet* features = nullptr;  ///< copied with the call where they are not resident
  std::size_t landmarks = 0;             ///< index of what is searched in it
};

struct ProjectionCall {
  ProjectionRule rule;  ///< pointers on the host
  std::span<const LandmarksToSearch> landmarks;
  std::span<const TargetToSearch> targets;
  bool want_in_view = false;
};

struct ProjectionFound {
  MatchLists lists;
  std::vector<std::uint32_t> in_view;   ///< bit i % 32 of word i / 32: landmark i; if wanted
  std::vector<std::size_t> first_word;  ///< [targets + 1]
  std::span<const std::uint32_t> words(std::size_t target) const {
    return std::span(in_view).subspan(first_word[target],
                                      first_word[target + 1] - first_word[target]);
  }
};

/// All landmarks in all their targets in one launch, claims resolved, at most one copy to the device
/// and one wait. False when the device failed: nothing is found then, and the failure is reported.
bool search_on_device(CudaSession& session, const ProjectionCall& call, ProjectionFound& found);

}  // namespace fastloop::matching
