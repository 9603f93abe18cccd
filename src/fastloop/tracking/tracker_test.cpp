#include "fastloop/tracking/tracker.hpp"

#include <gtest/gtest.h>

#include <deque>

#include "fastloop/core/error.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::tracking {
namespace {

using map::testing::SyntheticView;
using map::testing::SyntheticWorld;

constexpr Nanoseconds kFrameNs = 50'000'000;
/// Metres and radians: the mapping that stands in adjusts nothing, so errors add up from keyframe
/// to keyframe.
constexpr double kDrift = 0.2;

/// Turns requests into keyframes with stereo landmarks; the last `lag` requests are still waiting.
/// With an IMU it is initialised with the truth at the sixth keyframe, and later keyframes get
/// their true velocity.
class StandInMapping {
 public:
  StandInMapping(const SyntheticWorld& world, std::size_t lag, bool use_imu)
      : map_(world.rig, world.scales), lag_(lag), use_imu_(use_imu), snapshot_(map_.publish()) {}

  void submit(map::KeyframeRequest request) {
    ASSERT_EQ(request.id.value(), map_.keyframe_slots() + waiting_.size())
        << "ids are the order of the requests";
    const bool at_once = request.starts_map;
    waiting_.push_back(std::move(request));
    while (waiting_.size() > (at_once ? 0 : lag_)) {
      process(waiting_.front());
      waiting_.pop_front();
    }
    const auto fault = map_.find_inconsistency();
    EXPECT_FALSE(fault) << *fault;
    snapshot_ = map_.publish();
  }
  const std::shared_ptr<const map::Snapshot>& snapshot() const { return snapshot_; }

 private:
  void process(const map::KeyframeRequest& r) {
    const MapId id = r.starts_map ? map_.start_map() : map_.keyframe(r.reference).map;
    NavState state = r.state;
    if (!r.starts_map) state.T_world_body = map_.T_world_body(r.reference) * r.T_reference_body;
    const KeyframeId k = map_.add_keyframe(id, r.data, state, r.imu_from_previous);
    const FeatureSet& f = *r.data->features;
    for (std::uint32_t i = 0; i < f.size(); ++i) {
      const LandmarkId l = map_.resolve(r.landmarks[i]);
      if (l.valid() && map_.add_observation(l, k, i)) map_.refresh_landmark(l);
      if (map_.keyframe(k).landmarks[i].valid() || !f.has_depth(i)) continue;
      const Vector3d ray = map_.rig().left.unproject({f.x[i], f.y[i]});
      map_.add_landmark(k, i, map_.T_world_camera(k) * Vector3d(ray * (f.depth_m[i] / ray.z())));
    }
    map_.attach_to_spanning_tree(k);
    if (use_imu_) adjust_motion(id, k);
  }
  void adjust_motion(MapId id, KeyframeId newest) {
    map::MapInfo& info = map_.mutable_info(id);
    const auto truth = [&](KeyframeId k) {
      return synthetic::Motion::state(map_.keyframe(k).data->stamp_ns);
    };
    const bool now = !info.imu_initialized && info.num_keyframes >= 6;
    if (now) {
      map_.transform_map(id, truth(newest).T_world_body * map_.T_world_body(newest).inverse());
      info.imu_initialized = true;
    }
    if (!info.imu_initialized) return;
    for (KeyframeId k = newest; k.valid(); k = now ? map_.keyframe(k).previous : KeyframeId{}) {
      NavState state = map_.keyframe(k).state;
      state.v_world = truth(k).v_world;
      map_.set_state(k, state);
    }
  }

  map::Map map_;
  std::size_t lag_;
  bool use_imu_;
  std::deque<map::KeyframeRequest> waiting_;
  std::shared_ptr<const map::Snapshot> snapshot_;
};

/// A stream of frames along a motion, tracked one by one.
class Stream {
 public:
  explicit Stream(bool use_imu, std::size_t lag = 0)
      : world(2500, {4, 4, 2.5}, 3),
        mapping(world, lag, use_imu),
        tracker(options_for(use_imu), use_imu ? std::optional(ImuCalibration{}) : std::nullopt,
                nullptr) {}

  static TrackingOptions options_for(bool use_imu) {
    TrackingOptions options;
    options.use_imu = use_imu;
    return options;
  }
  /// The next frame; blind: without a single keypoint.
  TrackResult next(bool blind = false) {
    const SyntheticWorld& around = elsewhere ? *elsewhere : world;
    const Nanoseconds stamp = frame_ * kFrameNs;
    SyntheticView view;
    if (blind)
      finish(view, around.rig.left);
    else
      view = map::testing::observe(around, truth(), {.noise_px = 0.1, .clutter = 50}, rng_);
    std::vector<ImuSample> samples;
    if (imu_works)
      samples =
          synthetic::regular_samples(std::max<Nanoseconds>(0, stamp - kFrameNs), stamp, 5'000'000);
    for (ImuSample& s : samples) s.accel += accel_error;
    Tracker::Input input;
    input.id = FrameId(static_cast<std::uint32_t>(frame_));
    input.stamp_ns = stamp;
    input.features = view.features;
    input.imu = &samples;
    TrackResult result = tracker.track(input, mapping.snapshot());
    if (result.has_pose && !origin_) origin_ = truth() * result.T_world_body.inverse();
    if (result.keyframe) mapping.submit(*result.keyframe);
    ++frame_;
    if (result.state != state_)
      EXPECT_FALSE(result.reason.empty()) << to_string(state_) << " -> " << to_string(result.state);
    state_ = result.state;
    return result;
  }
  std::vector<TrackResult> run(int frames, bool blind = false) {
    std::vector<TrackResult> results;
    for (int i = 0; i < frames; ++i) results.push_back(next(blind));
    return results;
  }
  SE3 truth() const { return synthetic::Motion::state(frame_ * kFrameNs).T_world_body; }
  /// Distance of the last result from the truth, metres and radians. Visual maps start at their
  /// first frame.
  double error(const TrackResult& r) const {
    const SE3 T = synthetic::Motion::state((frame_ - 1) * kFrameNs).T_world_body;
    const bool metric = mapping.snapshot()->maps().back().imu_initialized;
    return T.local(metric ? r.T_world_body : *origin_ * r.T_world_body).norm();
  }
  void forget_origin() { origin_.reset(); }

  const SyntheticWorld world;
  StandInMapping mapping;
  Tracker tracker;
  bool imu_works = true;
  std::optional<SyntheticWorld> elsewhere;  ///< if set, what the camera sees instead of `world`
  Vector3d accel_error = Vector3d::Zero();

 private:
  std::mt19937 rng_{5};
  int frame_ = 0;
  std::optional<SE3> origin_;
  State state_ = State::kInitialising;
};

class TrackerWithLag : public ::testing::TestWithParam<std::size_t> {};

TEST_P(TrackerWithLag, FollowsASmoothMotion) {
  Stream stream(false, GetParam());
  int keyframes = 0;
  for (int i = 0; i < 160; ++i) {
    const TrackResult r = stream.next();
    ASSERT_EQ(r.state, State::kTracking) << i << ": " << r.reason;
    ASSERT_TRUE(r.has_pose);
    ASSERT_LT(stream.error(r), kDrift) << i;
    keyframes += r.keyframe.has_value();
  }
  EXPECT_GT(keyframes, 3);
  EXPECT_LT(keyframes, 80);
}

TEST_P(TrackerWithLag, StartsANewMapWhenLostForGoodAndNumbersItsKeyframesOn) {
  Stream stream(false, GetParam());
  stream.run(60);
  int recently_lost = 0;
  TrackResult r;
  for (r = stream.next(true); r.state == State::kRecentlyLost; r = stream.next(true)) {
    ++recently_lost;
    EXPECT_FALSE(r.has_pose);
    ASSERT_LT(recently_lost, 100);
  }
  EXPECT_EQ(r.state, State::kLost);
  EXPECT_FALSE(r.has_pose);
  EXPECT_NEAR(recently_lost * to_seconds(kFrameNs), 3.0, 0.15);
  r = stream.next(true);
  EXPECT_EQ(r.state, State::kInitialising);
  EXPECT_FALSE(r.has_pose);
  stream.forget_origin();
  r = stream.next();
  ASSERT_EQ(r.state, State::kTracking);
  ASSERT_TRUE(r.keyframe);
  EXPECT_TRUE(r.keyframe->starts_map);
  for (int i = 0; i < 40; ++i) {
    r = stream.next();
    ASSERT_EQ(r.state, State::kTracking);
    ASSERT_LT(stream.error(r), kDrift);
  }
  EXPECT_EQ(stream.mapping.snapshot()->maps().size(), 2u);
  EXPECT_EQ(stream.mapping.snapshot()->keyframe(r.reference).map, MapId(1));
}

INSTANTIATE_TEST_SUITE_P(Requests, TrackerWithLag, ::testing::Values(0u, 1u, 3u));

TEST(Tracker, RelocalisesAfterAShortBlindTime) {
  Stream stream(false);
  stream.run(60);
  for (const TrackResult& r : stream.run(20, true)) EXPECT_EQ(r.state, State::kRecentlyLost);
  bool back = false;
  for (int i = 0; i < 40; ++i) {
    const TrackResult r = stream.next();
    if (r.state == State::kTracking && !back)
      EXPECT_NE(r.reason.find("relocalised"), std::string::npos);
    if (back) {
      ASSERT_EQ(r.state, State::kTracking) << i;
    }
    back |= r.state == State::kTracking;
    if (back) {
      ASSERT_LT(stream.error(r), kDrift) << i;
    }
  }
  EXPECT_TRUE(back);
  EXPECT_EQ(stream.mapping.snapshot()->maps().size(), 1u);
}

TEST(Tracker, WaitsForEnoughDepthAndForTheFirstKeyframe) {
  Stream stream(false);
  for (const TrackResult& r : stream.run(3, true)) {
    EXPECT_EQ(r.state, State::kInitialising);
    EXPECT_FALSE(r.reason.empty());
    EXPECT_FALSE(r.has_pose);
  }
  Tracker::Input input;
  std::mt19937 rng(1);
  input.features = map::testing::observe(stream.world, stream.truth(), {}, rng).features;
  const auto empty = stream.mapping.snapshot();
  ASSERT_EQ(stream.tracker.track(input, empty).state, State::kTracking);
  input.stamp_ns += kFrameNs;
  EXPECT_THROW(stream.tracker.track(input, empty), InvalidArgument);
  EXPECT_THROW(Tracker(Stream::options_for(true), std::nullopt, nullptr), InvalidArgument);
}

class InertialTracker : public ::testing::TestWithParam<std::size_t> {
 protected:
  InertialTracker() : stream(true, GetParam()) {
    for (int i = 0; i < 100; ++i) {
      const TrackResult r = stream.next();
      EXPECT_EQ(r.state, State::kTracking) << i << ": " << r.reason;
      EXPECT_TRUE(i < 50 || stream.error(r) < kDrift) << i << ": " << stream.error(r);
    }
    EXPECT_TRUE(stream.mapping.snapshot()->maps()[0].imu_initialized);
  }
  /// Tracks on after a blind time; every frame must be right from the first.
  void expect_tracking(int frames) {
    for (int i = 0; i < frames; ++i) {
      const TrackResult r = stream.next();
      ASSERT_EQ(r.state, State::kTracking) << i << ": " << r.reason;
      ASSERT_LT(stream.error(r), kDrift) << i;
      if (r.keyframe) {
        const NavState truth = synthetic::Motion::state(r.keyframe->data->stamp_ns);
        EXPECT_LT((r.keyframe->state.v_world - truth.v_world).norm(), worst_velocity_error) << i;
      }
    }
  }
  Stream stream;
  double worst_velocity_error = 0.3;
};

TEST_P(InertialTracker, DeadReckoningBridgesOneSecond) {
  for (int i = 0; i < 20; ++i) {
    const TrackResult r = stream.next(true);
    EXPECT_EQ(r.state, State::kRecentlyLost);
    ASSERT_TRUE(r.has_pose);
    EXPECT_LT(stream.error(r), 0.25) << i;
  }
  expect_tracking(40);
}

/// Shaken while blind: dead reckoning is off by a metre, so that only relocalisation helps.
TEST_P(InertialTracker, RelocalisationIsNotTakenForMotion) {
  stream.accel_error = {0, 0, 2};
  TrackResult r;
  for (int i = 0; i < 20; ++i) r = stream.next(true);
  ASSERT_GT(stream.error(r), 0.5);
  stream.accel_error.setZero();
  worst_velocity_error = 3;  // 20 m/s would be the jump over one frame
  expect_tracking(40);
}

/// Carried to a place without a landmark while blind: good stereo, but no way back to the map.
TEST_P(InertialTracker, StereoPointsAloneAreNoRelocalisation) {
  stream.run(10, true);
  stream.elsewhere.emplace(2500, Vector3d(4, 4, 2.5), 77);
  for (const TrackResult& r : stream.run(40)) ASSERT_EQ(r.state, State::kRecentlyLost) << r.reason;
  stream.elsewhere.reset();
  worst_velocity_error = 3;
  expect_tracking(20);
}

TEST_P(InertialTracker, GoesOnWhenTheImuFallsSilent) {
  stream.imu_works = false;
  expect_tracking(60);
}

INSTANTIATE_TEST_SUITE_P(Requests, InertialTracker, ::testing::Values(0u, 1u));

}  // namespace
}  // namespace fastloop::tracking
