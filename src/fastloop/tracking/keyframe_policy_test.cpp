#include "fastloop/tracking/keyframe_policy.hpp"

#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"

namespace fastloop::tracking {
namespace {

/// A frame that needs no keyframe by any rule.
KeyframeSituation calm() {
  KeyframeSituation s;
  s.seconds_since_keyframe = 0.3;
  s.inliers = 100;
  s.reference_landmarks = 100;
  s.close_tracked = 200;
  return s;
}

TEST(KeyframePolicy, NothingIsDoneWithoutAReason) {
  EXPECT_FALSE(needs_keyframe(calm(), {}));
  KeyframeSituation s = calm();
  s.seconds_since_keyframe = 100;
  EXPECT_FALSE(needs_keyframe(s, {}));
}

TEST(KeyframePolicy, FewerLandmarksThanTheShareOfTheReference) {
  KeyframeSituation s = calm();
  s.inliers = 75;
  EXPECT_FALSE(needs_keyframe(s, {}));
  s.inliers = 74;
  EXPECT_TRUE(needs_keyframe(s, {}));
}

TEST(KeyframePolicy, NeverSoonerThanTheLeastInterval) {
  KeyframeSituation s = calm();
  s.inliers = 10;
  s.close_tracked = 0;
  s.close_untracked = 500;
  s.seconds_since_keyframe = 0.1;
  EXPECT_TRUE(needs_keyframe(s, {}));
  s.seconds_since_keyframe = 0.099;
  EXPECT_FALSE(needs_keyframe(s, {}));
}

TEST(KeyframePolicy, BusyMappingWaitsUnlessItIsUrgent) {
  KeyframeSituation s = calm();
  s.mapping_idle = false;
  s.inliers = 60;
  EXPECT_FALSE(needs_keyframe(s, {}));
  s.seconds_since_keyframe = 0.99;
  EXPECT_FALSE(needs_keyframe(s, {}));
  s.seconds_since_keyframe = 1.0;
  EXPECT_TRUE(needs_keyframe(s, {}));
  s.seconds_since_keyframe = 0.3;
  s.inliers = 40;
  EXPECT_FALSE(needs_keyframe(s, {}));
  s.inliers = 39;
  EXPECT_TRUE(needs_keyframe(s, {}));
}

TEST(KeyframePolicy, ClosePointsMissing) {
  KeyframeSituation s = calm();
  s.mapping_idle = false;
  s.close_tracked = 99;
  s.close_untracked = 71;
  EXPECT_TRUE(needs_keyframe(s, {}));
  s.close_untracked = 70;
  EXPECT_FALSE(needs_keyframe(s, {}));
  s.close_untracked = 71;
  s.close_tracked = 100;
  EXPECT_FALSE(needs_keyframe(s, {}));
}

TEST(KeyframePolicy, ImuNeedsKeyframesAtIntervals) {
  TrackingOptions options;
  options.use_imu = true;
  KeyframeSituation s = calm();
  s.mapping_idle = false;
  s.seconds_since_keyframe = 0.25;
  EXPECT_TRUE(needs_keyframe(s, options));
  s.seconds_since_keyframe = 0.249;
  EXPECT_FALSE(needs_keyframe(s, options));
  s.imu_initialized = true;
  s.seconds_since_keyframe = 0.499;
  EXPECT_FALSE(needs_keyframe(s, options));
  s.seconds_since_keyframe = 0.5;
  EXPECT_TRUE(needs_keyframe(s, options));
}

TEST(KeyframePolicy, CountsClosePoints) {
  map::testing::SyntheticView view;
  const Descriptor d;
  for (const double depth : {1.0, 2.0, 4.9, 5.1, 30.0})
    map::testing::add_keypoint(view, {10, 10}, 5, depth, 0, d, 0);
  map::testing::add_keypoint(view, {10, 10}, NAN, 0, 0, d, 0);
  TrackedFrame frame;
  frame.features = view.features;
  frame.landmarks.assign(6, LandmarkId{});
  frame.landmarks[1] = frame.landmarks[4] = frame.landmarks[5] = LandmarkId(3);
  KeyframeSituation s;
  s.close_tracked = s.close_untracked = 77;
  count_close_points(frame, 5, s);
  EXPECT_EQ(s.close_tracked, 1);
  EXPECT_EQ(s.close_untracked, 2);
}

TEST(TrackingOptions, RefuseWhatCannotWork) {
  EXPECT_NO_THROW(TrackingOptions{}.validate());
  TrackingOptions options;
  options.keyframe_match_ratio = 1.5;
  EXPECT_THROW(options.validate(), InvalidArgument);
  options = {};
  options.min_inliers = 5;
  EXPECT_THROW(options.validate(), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::tracking
