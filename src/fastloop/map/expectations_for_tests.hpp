#pragma once

#include <gtest/gtest.h>

#include "fastloop/map/snapshot.hpp"

namespace fastloop::map::testing {

/// Landmarks, observations and covisibility of two maps are the same to the last integer.
inline void expect_same_landmarks(const Snapshot& a, const Snapshot& b) {
  ASSERT_EQ(a.num_landmarks(), b.num_landmarks());
  for (std::uint32_t i = 0; i < a.landmark_slots(); ++i) {
    const Landmark &x = a.landmark(LandmarkId(i)), &y = b.landmark(LandmarkId(i));
    ASSERT_EQ(x.anchor, y.anchor);
    ASSERT_EQ(x.replaced_by, y.replaced_by);
    ASSERT_EQ(x.visible, y.visible);
    ASSERT_EQ(x.found, y.found);
    ASSERT_EQ(x.observations.size(), y.observations.size());
    for (std::size_t k = 0; k < x.observations.size(); ++k) {
      ASSERT_EQ(x.observations[k].keyframe, y.observations[k].keyframe);
      ASSERT_EQ(x.observations[k].keypoint, y.observations[k].keypoint);
    }
    if (x.removed()) continue;
    ASSERT_EQ(x.p_anchor, y.p_anchor);
    ASSERT_EQ(x.descriptor, y.descriptor);
    ASSERT_EQ(x.normal_anchor, y.normal_anchor);
    ASSERT_EQ(x.min_distance_m, y.min_distance_m);
    ASSERT_EQ(x.max_distance_m, y.max_distance_m);
  }
  ASSERT_EQ(a.keyframe_slots(), b.keyframe_slots());
  for (std::uint32_t i = 0; i < a.keyframe_slots(); ++i) {
    const KeyframeId id(i);
    ASSERT_EQ(a.keyframe(id).landmarks.size(), b.keyframe(id).landmarks.size());
    for (std::size_t k = 0; k < a.keyframe(id).landmarks.size(); ++k)
      ASSERT_EQ(a.keyframe(id).landmarks[k], b.keyframe(id).landmarks[k]);
    ASSERT_EQ(a.covisible(id).size(), b.covisible(id).size());
    for (std::size_t k = 0; k < a.covisible(id).size(); ++k) {
      ASSERT_EQ(a.covisible(id)[k].keyframe, b.covisible(id)[k].keyframe);
      ASSERT_EQ(a.covisible(id)[k].shared, b.covisible(id)[k].shared);
    }
  }
}

}  // namespace fastloop::map::testing
