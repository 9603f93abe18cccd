#pragma once

#include "fastloop/matching/projection_math.hpp"

namespace fastloop::matching {

/// Gates of several landmarks at a time, on processors that have AVX2; the same bits as `sight`.
struct SightBatch {
  static constexpr int kLanes = 8;
  alignas(32) float u[kLanes], v[kLanes], distance[kLanes], dot[kLanes];
  alignas(32) int level[kLanes];

  Sighting lane(int l) const { return {u[l], v[l], distance[l], dot[l], level[l]}; }
};

/// Whether this processor can do it.
bool can_sight_batches();

/// Looks at landmarks [first, first + count), count <= kLanes.
/// @return bit l: landmark first + l passed, and its lane of `out` is set
unsigned sight_batch(const ProjectionRule& rule, const TargetView& target,
                     const LandmarkArrays& landmarks, int first, int count, SightBatch* out);

}  // namespace fastloop::matching
