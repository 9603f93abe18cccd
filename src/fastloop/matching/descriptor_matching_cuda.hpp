#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/features/feature_set.hpp"
#include "fastloop/matching/bag_of_words.hpp"

namespace fastloop::matching {

struct SideToMatch {
  const FeatureSet* features = nullptr;  ///< copied with the call where they are not resident
  const FeatureGroups* groups = nullptr;
  const std::uint8_t* blocked = nullptr;  ///< [keypoints], or null
};

struct DescriptorCall {
  SideToMatch first;
  std::vector<SideToMatch> seconds;
  int max_distance = 0;
  float best_to_second = 1;
};

/// Keypoints that match, one of each image.
struct MatchedPair {
  std::uint16_t first, second;
};

/// Matches one image with all others in one launch (two, if only some have groups), claims resolved.
/// The input must have been checked.
/// @param[out] pairs  [seconds] ascending `second`
/// @return false when the device failed, which is reported
bool match_on_device(CudaSession& session, const DescriptorCall& call,
                     std::vector<std::vector<MatchedPair>>& pairs);

}  // namespace fastloop::matching
