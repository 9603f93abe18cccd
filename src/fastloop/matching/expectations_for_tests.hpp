#pragma once

#include <gtest/gtest.h>

#include "fastloop/matching/projection_search.hpp"

namespace fastloop::matching::testing {

inline void expect_equal(const ProjectionMatches& a, const ProjectionMatches& b) {
  EXPECT_EQ(a.keypoint, b.keypoint);
  EXPECT_EQ(a.distance, b.distance);
  EXPECT_EQ(a.in_view, b.in_view);
  EXPECT_EQ(a.count, b.count);
}

}  // namespace fastloop::matching::testing
