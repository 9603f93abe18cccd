#include "fastloop/mapping/mapper.hpp"

#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::mapping {
namespace {

using map::testing::SyntheticView;
using map::testing::SyntheticWorld;

constexpr Nanoseconds kStepNs = 200'000'000;

/// A tracker that knows the truth: requests with the right landmarks and nearly the right poses.
class Oracle {
 public:
  explicit Oracle(bool use_imu)
      : use_imu_(use_imu), world(1500, {6, 6, 3}, 4), landmark_of_(world.points.size()) {}

  map::KeyframeRequest request(bool starts_map, std::uint32_t slots) {
    const Nanoseconds stamp = step_ * kStepNs;
    views_.push_back(
        map::testing::observe(world, truth(step_), {.noise_px = 0.3, .clutter = 30}, rng_));
    const SyntheticView& view = views_.back();
    map::KeyframeRequest r;
    r.id = KeyframeId(slots);
    r.data = keyframe_data(view, FrameId(static_cast<std::uint32_t>(step_)), stamp);
    r.landmarks.assign(view.point.size(), LandmarkId{});
    r.starts_map = starts_map;
    if (starts_map) {
      std::fill(landmark_of_.begin(), landmark_of_.end(), LandmarkId{});
      origin_ = truth(step_);
    } else {
      for (std::size_t i = 0; i < view.point.size(); ++i)
        if (view.point[i] >= 0)
          r.landmarks[i] = landmark_of_[static_cast<std::size_t>(view.point[i])];
      for (const LandmarkId l : r.landmarks)
        if (l.valid() && r.sightings.size() < 50) r.sightings.push_back({l, 3, 2});
      r.reference = reference_;
      Vector6d d;
      d << map::testing::normal_vector(rng_, 0.001), map::testing::normal_vector(rng_, 0.005);
      r.T_reference_body = (truth(step_ - 1).inverse() * truth(step_)).retract(d);
      if (use_imu_) {
        const auto samples = synthetic::regular_samples(stamp - kStepNs, stamp, 5'000'000);
        r.imu_from_previous = std::make_shared<const PreintegratedImu>(
            samples, stamp - kStepNs, stamp, ImuBias{}, ImuCalibration{});
      }
    }
    r.state.T_world_body = expected();
    reference_ = r.id;
    ++step_;
    return r;
  }
  /// Remembers which landmark shows which point; ids of merged landmarks become stale on purpose.
  void look_at(const map::Map& map) {
    const map::Keyframe& k = map.keyframe(reference_);
    for (std::size_t i = 0; i < k.landmarks.size(); ++i) {
      const int p = views_.back().point[i];
      if (p >= 0 && k.landmarks[i].valid() && !landmark_of_[static_cast<std::size_t>(p)].valid())
        landmark_of_[static_cast<std::size_t>(p)] = k.landmarks[i];
    }
  }
  /// Of the newest keyframe, as seen from the first of its map.
  SE3 expected() const { return origin_.inverse() * truth(step_); }
  static SE3 truth(int step) { return synthetic::Motion::state(step * kStepNs).T_world_body; }
  int step() const { return step_; }

 private:
  bool use_imu_;
  std::mt19937 rng_{7};

 public:
  const SyntheticWorld world;

 private:
  std::vector<LandmarkId> landmark_of_;
  std::vector<SyntheticView> views_;
  SE3 origin_;
  KeyframeId reference_;
  int step_ = 0;
};

class MapperSequence : public ::testing::TestWithParam<bool> {};

TEST_P(MapperSequence, KeepsTheMapConsistentAndThePosesRight) {
  Oracle oracle(GetParam());
  MappingOptions options;
  options.use_imu = GetParam();
  std::shared_ptr<const map::Snapshot> published;
  std::vector<ImuStep> steps;
  StageTimes times;
  Mapper mapper(oracle.world.rig, oracle.world.scales, options,
                {[&](std::shared_ptr<const map::Snapshot> s) { published = std::move(s); },
                 [&](Nanoseconds, const ImuStep& step) { steps.push_back(step); }},
                &times);
  constexpr int kKeyframes = 36, kSecondMapAt = 30;
  for (int i = 0; i < kKeyframes; ++i) {
    const bool starts = i == 0 || i == kSecondMapAt;
    mapper.process(oracle.request(starts, static_cast<std::uint32_t>(i)), i % 7 == 3);
    const auto fault = mapper.map().find_inconsistency();
    ASSERT_FALSE(fault) << "keyframe " << i << ": " << *fault;
    ASSERT_TRUE(published);
    EXPECT_EQ(published->version(), mapper.map().version());
    oracle.look_at(mapper.map());
    if (i != kSecondMapAt - 1) continue;
    std::vector<double> errors;
    for (std::uint32_t k = 0; k < kSecondMapAt; ++k) {
      const SE3 expected = Oracle::truth(0).inverse() * Oracle::truth(static_cast<int>(k));
      const SE3 found = mapper.map().T_world_body(KeyframeId(0)).inverse() *
                        mapper.map().T_world_body(KeyframeId(k));
      errors.push_back(expected.local(found).norm());
    }
    EXPECT_LT(*std::max_element(errors.begin(), errors.end()), 0.05);
  }
  EXPECT_EQ(mapper.map().maps().size(), 2u);
  EXPECT_GT(mapper.map().num_landmarks(), 300u);
  EXPECT_EQ(mapper.map().map_info(MapId(0)).imu_initialized, GetParam());
  EXPECT_EQ(std::any_of(steps.begin(), steps.end(),
                        [](const ImuStep& s) { return s.kind == ImuStep::Kind::kInitialised; }),
            GetParam());
  for (const ImuStep& s : steps) EXPECT_FALSE(s.reason.empty());
  EXPECT_EQ(times.samples("insert").size(), static_cast<std::size_t>(kKeyframes));
}

INSTANTIATE_TEST_SUITE_P(Imu, MapperSequence, ::testing::Values(false, true));

TEST(Mapper, RefusesRequestsOutOfOrderAndWrongOptions) {
  Oracle oracle(false);
  Mapper mapper(oracle.world.rig, oracle.world.scales, {}, {}, nullptr);
  EXPECT_THROW(mapper.process(oracle.request(true, 3), false), Error);
  MappingOptions options;
  options.threads = 0;
  EXPECT_THROW(Mapper(oracle.world.rig, oracle.world.scales, options, {}, nullptr),
               InvalidArgument);
}

}  // namespace
}  // namespace fastloop::mapping
