#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>

#include "fastloop/map/essential_graph.hpp"
#include "simulated_loop.hpp"

/// The bounds that a correction has to keep, each with a correction just inside and one just
/// outside.
namespace fastloop::loop {
namespace {

using map::CorrectionLimits;
using map::LoopCorrection;
using testing::Attempt;
using testing::small_world;

constexpr double kOff = 1e-6;

class Limits : public ::testing::Test {
 protected:
  static const Attempt& attempt() {
    static const Attempt a(small_world(), Backend::kCpu);
    return a;
  }
  void SetUp() override { ASSERT_TRUE(attempt().outcome.correction.has_value()); }

  std::optional<std::string> fault() const {
    const auto cpu = find_fault(map_, correction_, limits_, Executor::cpu());
    EXPECT_EQ(find_fault(map_, correction_, limits_, Executor::reference()), cpu);
    return cpu;
  }
  bool sound() const { return !fault().has_value(); }
  SE3 after(KeyframeId id) const {
    for (const map::CorrectedState& s : correction_.states)
      if (s.keyframe == id) return s.after.T_world_body;
    return map_.T_world_body(id);
  }
  /// Reprojection error over the octave's scale, under the corrected poses.
  double error_px(LandmarkId l, KeyframeId k, std::uint32_t keypoint) const {
    const map::Landmark& landmark = map_.landmark(l);
    const Vector3d p = (after(k) * map_.rig().T_body_left).inverse() *
                       (after(landmark.anchor) * landmark.p_anchor);
    const FeatureSet& f = *map_.keyframe(k).data->features;
    return (map_.rig().left.project(p) - Eigen::Vector2d(f.x[keypoint], f.y[keypoint])).norm() /
           static_cast<double>(map_.scales().scale[f.octave[keypoint]]);
  }

  const map::Map& map_ = attempt().world.map;
  LoopCorrection correction_ = *attempt().outcome.correction;
  CorrectionLimits limits_;
};

TEST_F(Limits, LoopEdgeInMetresAndRadians) {
  const SE3 exact = after(correction_.edge.a).inverse() * after(correction_.edge.b);
  for (const Vector3d& way : {Vector3d(1, 0, 0), Vector3d(0, 0.6, -0.8)}) {
    for (const double off : {-kOff, kOff}) {
      correction_.edge.T_a_b = exact;
      correction_.edge.T_a_b.translation += (limits_.max_edge_error_m + off) * way;
      EXPECT_EQ(sound(), off < 0);
      correction_.edge.T_a_b = exact;
      correction_.edge.T_a_b.rotation =
          exact.rotation * so3::exp((limits_.max_edge_error_rad + off) * way);
      EXPECT_EQ(sound(), off < 0);
      if (off > 0) {
        EXPECT_NE(fault()->find("contradict"), std::string::npos);
      }
    }
  }
}

TEST_F(Limits, GateOfAJoinedObservation) {
  const std::vector<map::NewObservation> all = correction_.observations;
  ASSERT_GT(all.size(), 3u);
  correction_.merges.clear();
  for (std::size_t i = 0; i < std::min<std::size_t>(all.size(), 10); ++i) {
    correction_.observations = {all[i]};
    const double error = error_px(all[i].landmark, all[i].keyframe, all[i].keypoint);
    limits_.observation_gate_px = error + kOff;
    EXPECT_TRUE(sound());
    limits_.observation_gate_px = error - kOff;
    EXPECT_FALSE(sound());
  }
}

TEST_F(Limits, GateOfAMerge) {
  const std::vector<map::LandmarkMerge> all = correction_.merges;
  correction_.observations.clear();
  for (std::size_t i = 0; i < std::min<std::size_t>(all.size(), 10); ++i) {
    correction_.merges = {all[i]};
    const map::Observation& seen = map_.landmark(all[i].loser).observations.back();
    const double error = error_px(all[i].winner, seen.keyframe, seen.keypoint);
    limits_.observation_gate_px = error + kOff;
    EXPECT_TRUE(sound());
    limits_.observation_gate_px = error - kOff;
    EXPECT_FALSE(sound());
  }
}

TEST_F(Limits, HalfOfWhatIsJoinedMustFit) {
  // One that fits to the pixel, and copies of it at a keypoint far away.
  const map::NewObservation good = correction_.observations.front();
  const FeatureSet& f = *map_.keyframe(good.keyframe).data->features;
  map::NewObservation bad = good;
  for (std::uint32_t i = 0; i < f.size(); ++i)
    if (error_px(good.landmark, good.keyframe, i) > 40) bad.keypoint = i;
  ASSERT_NE(bad.keypoint, good.keypoint);
  correction_.merges.clear();
  for (int number = 1; number < 6; ++number)
    for (int fit = 0; fit <= number; ++fit) {
      correction_.observations.assign(static_cast<std::size_t>(fit), good);
      correction_.observations.resize(static_cast<std::size_t>(number), bad);
      EXPECT_EQ(sound(), 2 * fit >= number) << fit << " of " << number;
    }
}

TEST_F(Limits, GrowthOfTheMedianReprojectionError) {
  // A map bent a little, keyframe by keyframe: its errors grow.
  for (std::size_t i = 0; i < correction_.states.size(); ++i)
    if (correction_.states[i].keyframe != correction_.edge.a &&
        correction_.states[i].keyframe != correction_.edge.b)
      correction_.states[i].after.T_world_body.translation.z() += i % 2 ? 0.02 : -0.02;
  limits_.observation_gate_px = 1e5;
  limits_.max_growth = 1e-9;
  limits_.growth_floor_px = 1e-9;
  const std::string text = fault().value_or("");
  double before = 0, after = 0;
  ASSERT_EQ(std::sscanf(text.c_str(), "the median reprojection error would grow from %lf to %lf px",
                        &before, &after),
            2)
      << text;
  ASSERT_GT(after, 1.5 * before);
  ASSERT_GT(before, 0.3);
  // Two digits are told.
  const double slack = 0.01 / before + 0.01 / after;
  limits_.max_growth = after / before * (1 + slack);
  EXPECT_TRUE(sound());
  limits_.max_growth = after / before * (1 - slack);
  EXPECT_FALSE(sound());
  // The floor stands in for smaller errors.
  limits_.max_growth = 1;
  limits_.growth_floor_px = after + 0.01;
  EXPECT_TRUE(sound());
  limits_.growth_floor_px = after - 0.01;
  EXPECT_FALSE(sound());
}

}  // namespace
}  // namespace fastloop::loop
