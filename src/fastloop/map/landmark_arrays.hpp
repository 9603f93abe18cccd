#pragma once

#include <span>
#include <vector>

#include "fastloop/map/snapshot.hpp"
#include "fastloop/matching/projection_search.hpp"

namespace fastloop::map {

/// Landmarks of a snapshot as the flat arrays that a projection search takes.
struct LandmarkArrays {
  std::vector<LandmarkId> ids;
  std::vector<Eigen::Vector3f> p_world, normal_world;
  std::vector<float> min_distance_m, max_distance_m;
  std::vector<Descriptor> descriptor;

  LandmarkArrays() = default;
  LandmarkArrays(const Snapshot& snapshot, std::vector<LandmarkId> chosen,
                 const Executor& executor = Executor::reference());

  std::size_t size() const { return ids.size(); }
  matching::LandmarkView view() const {
    return {p_world, normal_world, min_distance_m, max_distance_m, descriptor};
  }
};

/// Landmarks that at least one of the keyframes sees, ascending, each once.
std::vector<LandmarkId> landmarks_of(const Snapshot& snapshot,
                                     std::span<const KeyframeId> keyframes);

}  // namespace fastloop::map
