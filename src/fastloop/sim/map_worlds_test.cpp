#include "fastloop/sim/map_worlds.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <set>
#include <unordered_map>

#include "fastloop/core/error.hpp"
#include "fastloop/place/default_vocabulary.hpp"

namespace fastloop::sim {
namespace {

MapWorldOptions small(int keyframes = 200) {
  MapWorldOptions o;
  o.keyframes = keyframes;
  o.features = 300;
  o.covisible = 12;
  return o;
}

/// Squared residuals over their variance, of every observation.
std::vector<double> normalised_errors(const map::Map& m) {
  std::vector<double> errors;
  for (std::uint32_t l = 0; l < m.landmark_slots(); ++l)
    for (const map::Observation& o : m.landmark(LandmarkId(l)).observations) {
      const Vector3d p = m.T_world_camera(o.keyframe).inverse() * m.p_world(LandmarkId(l));
      StereoRig::Residual r;
      const auto z = m.pixel(o.keyframe, o.keypoint);
      const int n = m.rig().residual(p, z, &r);
      const auto octave = m.keyframe(o.keyframe).data->features->octave[o.keypoint];
      double sum = n == 0 ? 1e9 : 0;
      for (int i = 0; i < n; ++i) sum += r[i] * r[i] / n;
      errors.push_back(sum / m.scales().sigma2[octave]);
    }
  return errors;
}

double quantile(std::vector<double> v, double q) {
  const auto at = v.begin() + static_cast<std::ptrdiff_t>(q * static_cast<double>(v.size() - 1));
  std::nth_element(v.begin(), at, v.end());
  return *at;
}

SE3 mapped_relation(const SimulatedMap& s) {
  return s.map.T_world_body(s.expected_matches[0]).inverse() * s.map.T_world_body(s.current);
}

class MapWorlds : public ::testing::TestWithParam<int> {
 protected:
  /// One of the kinds of map that can be asked for.
  MapWorldOptions options() const {
    MapWorldOptions o = small(300);
    o.fisheye = GetParam() & 1;
    o.two_maps = GetParam() & 2;
    o.loops = GetParam() & 4 ? 2 : 0;
    o.inertial = GetParam() & 1;
    o.seed = static_cast<std::uint64_t>(GetParam()) + 1;
    return o;
  }
};

TEST_P(MapWorlds, IsConsistentAndAgreesWithItsKeypoints) {
  const MapWorldOptions o = options();
  const SimulatedMap s = simulate_map(o);
  EXPECT_EQ(s.map.find_inconsistency().value_or(""), "");
  EXPECT_EQ(s.map.num_keyframes(), 300u);
  EXPECT_EQ(s.map.maps().size(), o.two_maps ? 2u : 1u);
  EXPECT_EQ(s.map.loop_edges().size(), static_cast<std::size_t>(o.loops));
  EXPECT_EQ(s.map.maps()[0].imu_initialized, o.inertial);
  EXPECT_EQ(s.truth.size(), s.map.keyframe_slots());
  EXPECT_EQ(s.point_of.size(), s.map.landmark_slots());
  for (std::uint32_t k = 0; k < 300; ++k)
    ASSERT_EQ(s.map.keyframe(KeyframeId(k)).data->features->size(), 300u);
  const auto errors = normalised_errors(s.map);
  EXPECT_GT(errors.size(), 300u * 80u);
  // Noise alone gives 0.25 (half a pixel, squared).
  EXPECT_LT(quantile(errors, 0.5), 0.5);
  EXPECT_LT(quantile(errors, 0.95), 2.5);
}

TEST_P(MapWorlds, TruthBringsTheDuplicatesTogether) {
  const SimulatedMap s = simulate_map(options());
  // Two landmarks of one world point: where the revisit maps it again.
  std::unordered_map<std::uint32_t, LandmarkId> first;
  const SE3 T_matched_world = s.map.T_world_body(s.expected_matches[0]).inverse();
  const SE3 T_current_world = s.map.T_world_body(s.current).inverse();
  std::vector<double> apart, before;
  for (std::uint32_t l = 0; l < s.map.landmark_slots(); ++l) {
    const auto [it, fresh] = first.try_emplace(s.point_of[l], LandmarkId(l));
    if (fresh) continue;
    const Vector3d in_matched = T_matched_world * s.map.p_world(it->second);
    const Vector3d in_current = T_current_world * s.map.p_world(LandmarkId(l));
    apart.push_back((in_matched - s.T_matched_current * in_current).norm());
    before.push_back((in_matched - mapped_relation(s) * in_current).norm());
  }
  EXPECT_GT(apart.size(), 100u);
  EXPECT_LT(quantile(apart, 0.5), 0.03);
  EXPECT_GT(quantile(before, 0.5), 2 * quantile(apart, 0.5));
}

TEST_P(MapWorlds, NoLandmarkIsSeenFromBothSidesOfThePendingLoop) {
  const SimulatedMap s = simulate_map(options());
  std::set<std::uint32_t> old;
  for (const KeyframeId k : s.expected_matches) old.insert(k.value());
  EXPECT_GE(old.size(), 5u);
  for (std::uint32_t k = 295; k < 300; ++k)
    for (const auto& edge : s.map.covisible(KeyframeId(k)))
      EXPECT_FALSE(old.contains(edge.keyframe.value())) << k;
}

TEST_P(MapWorlds, ClosedLoopsAreKnownToTheMap) {
  const SimulatedMap s = simulate_map(options());
  for (const map::LoopEdge& e : s.map.loop_edges()) {
    EXPECT_GT(e.b.value(), e.a.value() + 10);
    const auto& near = s.map.covisible(e.a);
    EXPECT_TRUE(std::any_of(near.begin(), near.end(), [&](const auto& edge) {
      return edge.keyframe == e.b && edge.shared > 20;
    }));
    const SE3 truth = s.truth[e.a.value()].inverse() * s.truth[e.b.value()];
    EXPECT_LT((truth.translation - e.T_a_b.translation).norm(), 0.02);
  }
}

INSTANTIATE_TEST_SUITE_P(Kinds, MapWorlds, ::testing::Range(0, 8));

TEST(SimulateMap, DriftIsAsAskedForAndInYawAndPosition) {
  double before = -1;
  for (const double scale : {0.0, 1.0, 2.0}) {
    MapWorldOptions o = small(400);
    o.drift_scale = scale;
    const SimulatedMap s = simulate_map(o);
    const double way = 399 * 0.4;  // with so few covisible keyframes they are 0.4 m apart
    const SE3 mapped = s.map.T_world_body(s.current);
    const SE3& truth = s.truth[s.current.value()];
    const double error = (mapped.translation - truth.translation).norm();
    EXPECT_NEAR(error, 0.003 * scale * way, 0.0003 * scale * way + 1e-9);
    const Vector3d turned = so3::log(mapped.rotation * truth.rotation.conjugate());
    EXPECT_LT(turned.head<2>().norm(), 1e-9);
    EXPECT_EQ(std::abs(turned.z()) > 1e-4, scale > 0);
    EXPECT_GT(error, before);
    before = error;
    EXPECT_LT((s.map.T_world_body(KeyframeId(0)).translation - s.truth[0].translation).norm(),
              1e-9);
  }
}

TEST(SimulateMap, SecondMapOfAnInertialPairIsTurnedAboutTheVerticalAlone) {
  MapWorldOptions o = small();
  o.two_maps = true;
  for (const bool inertial : {true, false}) {
    o.inertial = inertial;
    const SimulatedMap s = simulate_map(o);
    const Eigen::Quaterniond turn =
        s.map.T_world_body(s.current).rotation * s.truth[s.current.value()].rotation.conjugate();
    EXPECT_EQ((turn * Vector3d::UnitZ() - Vector3d::UnitZ()).norm() < 1e-6, inertial);
    EXPECT_NE(s.map.keyframe(s.current).map, s.map.keyframe(s.expected_matches[0]).map);
  }
}

TEST(SimulateMap, SameSeedSameMapOtherSeedOtherMap) {
  MapWorldOptions o = small(100);
  const SimulatedMap a = simulate_map(o), b = simulate_map(o);
  o.seed = 2;
  const SimulatedMap c = simulate_map(o);
  const auto words = [](const SimulatedMap& s) {
    return s.map.keyframe(s.current).data->features->descriptors;
  };
  EXPECT_EQ(words(a), words(b));
  EXPECT_EQ(a.map.T_world_body(a.current).matrix(), b.map.T_world_body(b.current).matrix());
  EXPECT_EQ(a.map.num_landmarks(), b.map.num_landmarks());
  EXPECT_NE(words(a), words(c));
}

TEST(SimulateMap, CovisibilityIsAboutWhatWasAskedFor) {
  for (const int wanted : {12, 40}) {
    MapWorldOptions o = small(400);
    o.covisible = wanted;
    const SimulatedMap s = simulate_map(o);
    const auto neighbours = static_cast<double>(s.map.covisible(KeyframeId(150)).size());
    EXPECT_GT(neighbours, 0.6 * wanted);
    EXPECT_LT(neighbours, 1.4 * wanted);
  }
}

TEST(SimulateMap, RevisitsScoreHigherThanOtherPlaces) {
  MapWorldOptions o = small(300);
  o.features = 1000;
  const SimulatedMap s = simulate_map(o);
  const auto bag = [&](KeyframeId k) {
    return place::default_vocabulary()
        .transform(s.map.keyframe(k).data->features->descriptors)
        .vector;
  };
  const auto current = bag(s.current);
  const float revisit = place::l1_score(current, bag(s.expected_matches[0]));
  float elsewhere = 0;
  for (std::uint32_t k = 40; k < 260; k += 4)
    elsewhere = std::max(elsewhere, place::l1_score(current, bag(KeyframeId(k))));
  EXPECT_GT(revisit, 2 * elsewhere) << revisit << " " << elsewhere;
}

TEST(SimulateMap, TooFewKeyframesForTheLoopsAreRefused) {
  MapWorldOptions o = small(100);
  o.loops = 20;
  EXPECT_THROW(simulate_map(o), InvalidArgument);
  o.loops = -1;
  EXPECT_THROW(simulate_map(o), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::sim
