#include "fastloop/map/map.hpp"

#include <gtest/gtest.h>

#include <cstring>
#include <set>

#include "fastloop/core/error.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::map {
namespace {

using testing::normal_vector;

constexpr std::size_t kKeypoints = 30;
constexpr Nanoseconds kStepNs = 100'000'000;

NavState random_state(std::mt19937& rng) {
  NavState s;
  s.T_world_body = SE3(so3::exp(normal_vector(rng, 0.5)), normal_vector(rng, 2));
  s.v_world = normal_vector(rng, 1);
  return s;
}

std::shared_ptr<const KeyframeData> random_data(std::mt19937& rng, Nanoseconds stamp_ns) {
  testing::SyntheticView view;
  std::uniform_real_distribution<double> u(0, 1);
  for (std::size_t i = 0; i < kKeypoints; ++i)
    testing::add_keypoint(view, {750 * u(rng), 478 * u(rng)}, NAN, 0, static_cast<int>(rng() % 8),
                          testing::random_descriptor(rng), -1);
  testing::finish(view, testing::pinhole_rig().left);
  return testing::keyframe_data(view, FrameId(static_cast<std::uint32_t>(rng() % 1000)), stamp_ns);
}

std::shared_ptr<const PreintegratedImu> imu_between(Nanoseconds begin_ns, Nanoseconds end_ns) {
  const auto samples = synthetic::regular_samples(begin_ns, end_ns, 10'000'000);
  return std::make_shared<const PreintegratedImu>(samples, begin_ns, end_ns, ImuBias{},
                                                  ImuCalibration{});
}

/// Everything a reader can see, mixed into one number.
std::uint64_t digest(const Snapshot& s) {
  std::uint64_t h = 1469598103934665603ULL;
  const auto mix = [&](const auto& value) {
    unsigned char bytes[sizeof(value)];
    std::memcpy(bytes, &value, sizeof(value));
    for (const unsigned char b : bytes) h = (h ^ b) * 1099511628211ULL;
  };
  const auto mix_vector = [&](const Vector3d& v) { mix(v.x()), mix(v.y()), mix(v.z()); };
  mix(s.version()), mix(s.pose_version()), mix(s.num_keyframes()), mix(s.num_landmarks());
  for (std::uint32_t i = 0; i < s.keyframe_slots(); ++i) {
    const Keyframe& k = s.keyframe(KeyframeId(i));
    const SE3 T = s.T_world_body(KeyframeId(i));
    mix_vector(T.translation), mix_vector(T.rotation.vec()), mix_vector(k.state.v_world);
    mix(k.removed), mix(k.parent), mix(k.previous), mix(k.next), mix(k.imu_from_previous.get());
    for (const LandmarkId l : k.landmarks) mix(l);
    for (const CovisibilityEdge& e : s.covisible(KeyframeId(i))) mix(e.keyframe), mix(e.shared);
  }
  for (std::uint32_t i = 0; i < s.landmark_slots(); ++i) {
    const Landmark& l = s.landmark(LandmarkId(i));
    mix(l.anchor), mix(l.replaced_by), mix(l.visible), mix(l.found), mix_vector(l.p_anchor);
    for (const auto word : l.descriptor.words) mix(word);
    for (const Observation& o : l.observations) mix(o.keyframe), mix(o.keypoint);
  }
  for (const MapInfo& m : s.maps())
    mix(m.last_keyframe), mix(m.num_keyframes), mix(m.imu_initialized);
  return h;
}

/// Random operations on two maps.
class RandomMap {
 public:
  explicit RandomMap(unsigned seed) : rng(seed), map(testing::pinhole_rig(), PyramidScales()) {
    for (int m = 0; m < 2; ++m) {
      map.start_map();
      for (int i = 0; i < 3; ++i) add_keyframe(MapId(static_cast<std::uint32_t>(m)));
    }
  }

  void step() {
    switch (rng() % 16) {
      case 0:
        return add_keyframe(MapId(rng() % 2));
      case 1:
        return remove_some_keyframe();
      case 2:
        return set_some_state();
      case 3:
        if (rng() % 20 == 0) map.transform_map(MapId(rng() % 2), random_state(rng).T_world_body);
        return;
      case 4:
        return merge();
      case 5:
        if (rng() % 2 == 0) map.remove_landmark(some_landmark());
        return;
      case 6: {
        const LandmarkId l = some_landmark();
        if (map.contains(l)) map.remove_observation(l, observer(l), static_cast<int>(rng() % 3));
        return;
      }
      case 7: {
        const LandmarkId l = some_landmark();
        if (!map.contains(l)) return;
        const Vector3d p = normal_vector(rng, 4);
        map.set_p_world(l, p);
        ASSERT_LT((map.p_world(l) - p).norm(), 1e-9);
        return;
      }
      case 8: {
        const LandmarkId l = some_landmark();
        if (map.contains(l)) map.refresh_landmark(l);
        return;
      }
      case 9:
      case 10:
        return add_landmark();
      default:
        return add_observation();
    }
  }

  std::mt19937 rng;
  Map map;

 private:
  KeyframeId some_keyframe() {
    for (;;) {
      const KeyframeId k(static_cast<std::uint32_t>(rng() % map.keyframe_slots()));
      if (map.contains(k)) return k;
    }
  }
  LandmarkId some_landmark() {
    return map.landmark_slots()
               ? LandmarkId(static_cast<std::uint32_t>(rng() % map.landmark_slots()))
               : LandmarkId{};
  }
  KeyframeId observer(LandmarkId l) {
    const auto& observations = map.landmark(l).observations;
    return observations[rng() % observations.size()].keyframe;
  }
  void add_keyframe(MapId m) {
    const KeyframeId last = map.map_info(m).last_keyframe;
    const Nanoseconds stamp = last.valid() ? map.keyframe(last).data->stamp_ns + kStepNs : 0;
    const bool with_imu = last.valid() && rng() % 4 != 0;
    const KeyframeId k = map.add_keyframe(m, random_data(rng, stamp), random_state(rng),
                                          with_imu ? imu_between(stamp - kStepNs, stamp) : nullptr);
    for (int i = 0; i < 20; ++i) map.add_observation(some_landmark(), k, rng() % kKeypoints);
    map.attach_to_spanning_tree(k);
  }
  void remove_some_keyframe() {
    const KeyframeId k = some_keyframe();
    const MapInfo& info = map.map_info(map.keyframe(k).map);
    if (k == info.first_keyframe || k == info.last_keyframe) {
      EXPECT_THROW(map.remove_keyframe(k), InvalidArgument);
      return;
    }
    const SE3 T = map.T_world_body(k);
    map.remove_keyframe(k);
    EXPECT_LT(T.local(map.T_world_body(k)).norm(), 1e-9);
    EXPECT_THROW(map.remove_keyframe(k), InvalidArgument);
  }
  void set_some_state() {
    const KeyframeId k = some_keyframe();
    map.set_state(k, random_state(rng));
  }
  void add_landmark() {
    const KeyframeId k = some_keyframe();
    const auto keypoint = static_cast<std::uint32_t>(rng() % kKeypoints);
    if (map.keyframe(k).landmarks[keypoint].valid()) return;
    const Vector3d p = normal_vector(rng, 4);
    const LandmarkId l = map.add_landmark(k, keypoint, p);
    EXPECT_LT((map.p_world(l) - p).norm(), 1e-9);
  }
  void add_observation() {
    const LandmarkId l = some_landmark();
    const KeyframeId k = some_keyframe();
    const auto keypoint = static_cast<std::uint32_t>(rng() % kKeypoints);
    if (!l.valid()) return;
    const auto& seen = map.landmark(l).observations;
    const bool possible = map.contains(l) && !map.keyframe(k).landmarks[keypoint].valid() &&
                          std::none_of(seen.begin(), seen.end(),
                                       [&](const Observation& o) { return o.keyframe == k; });
    EXPECT_EQ(map.add_observation(l, k, keypoint), possible);
  }
  void merge() {
    const LandmarkId loser = some_landmark(), winner = some_landmark();
    if (!map.contains(loser) || !map.contains(winner) || loser == winner) return;
    std::set<KeyframeId> observers;
    for (const LandmarkId l : {loser, winner})
      for (const Observation& o : map.landmark(l).observations) observers.insert(o.keyframe);
    const Vector3d p = map.p_world(winner);
    map.replace_landmark(loser, winner);
    EXPECT_EQ(map.resolve(loser), winner);
    EXPECT_EQ(map.landmark(winner).observations.size(), observers.size());
    EXPECT_LT((map.p_world(winner) - p).norm(), 1e-9);
  }
};

TEST(Map, StaysConsistentUnderRandomOperationsAndSnapshotsDoNotChange) {
  for (unsigned seed = 0; seed < 6; ++seed) {
    RandomMap random(seed);
    std::vector<std::pair<std::shared_ptr<const Snapshot>, std::uint64_t>> snapshots;
    for (int batch = 0; batch < 60; ++batch) {
      for (int i = 0; i < 40; ++i) random.step();
      const auto fault = random.map.find_inconsistency();
      ASSERT_FALSE(fault) << "seed " << seed << ", batch " << batch << ": " << *fault;
      const auto snapshot = random.map.publish();
      snapshots.emplace_back(snapshot, digest(*snapshot));
      ASSERT_EQ(digest(*snapshot), digest(random.map));
    }
    for (const auto& [snapshot, expected] : snapshots) EXPECT_EQ(digest(*snapshot), expected);
    EXPECT_NE(snapshots.front().second, snapshots.back().second);
  }
}

TEST(Map, CovisibilityEqualsTheSharedLandmarksOfBruteForce) {
  RandomMap random(11);
  for (int i = 0; i < 1500; ++i) random.step();
  const Map& map = random.map;
  for (std::uint32_t a = 0; a < map.keyframe_slots(); ++a) {
    std::vector<CovisibilityEdge> expected;
    for (std::uint32_t b = 0; b < map.keyframe_slots(); ++b) {
      int shared = 0;
      for (const LandmarkId l : map.keyframe(KeyframeId(a)).landmarks)
        if (a != b && l.valid())
          for (const LandmarkId other : map.keyframe(KeyframeId(b)).landmarks) shared += other == l;
      if (shared > 0) expected.push_back({KeyframeId(b), shared});
    }
    const auto& found = map.covisible(KeyframeId(a));
    ASSERT_EQ(found.size(), expected.size());
    for (std::size_t i = 0; i < found.size(); ++i) {
      EXPECT_EQ(found[i].keyframe, expected[i].keyframe);
      EXPECT_EQ(found[i].shared, expected[i].shared);
    }
    std::stable_sort(expected.begin(), expected.end(),
                     [](const auto& x, const auto& y) { return x.shared > y.shared; });
    const auto best = map.best_covisible(KeyframeId(a), 3);
    ASSERT_EQ(best.size(), std::min<std::size_t>(3, expected.size()));
    for (std::size_t i = 0; i < best.size(); ++i) EXPECT_EQ(best[i], expected[i].keyframe);
  }
}

/// A chain of keyframes with IMU; keyframes i and j share landmarks when |i - j| <= 2.
class MapOfChain : public ::testing::Test {
 protected:
  MapOfChain() : map(testing::pinhole_rig(), PyramidScales()) {
    const MapId id = map.start_map();
    for (int i = 0; i < 6; ++i) {
      const KeyframeId k =
          map.add_keyframe(id, random_data(rng, i * kStepNs), random_state(rng),
                           i ? imu_between((i - 1) * kStepNs, i * kStepNs) : nullptr);
      for (std::size_t j = 0; j < landmarks.size(); ++j)
        if (landmarks.size() - j <= 8)
          map.add_observation(landmarks[j], k, static_cast<std::uint32_t>(j % 8));
      for (std::uint32_t j = 0; j < 4; ++j)
        if (!map.keyframe(k).landmarks[8 + j].valid())
          landmarks.push_back(map.add_landmark(k, 8 + j, normal_vector(rng, 3)));
      map.attach_to_spanning_tree(k);
    }
  }
  std::mt19937 rng{5};
  Map map;
  std::vector<LandmarkId> landmarks;
};

TEST_F(MapOfChain, RemovalJoinsTheImuMeasurementsOfBothNeighbours) {
  map.remove_keyframe(KeyframeId(2));
  const auto joined = map.keyframe(KeyframeId(3)).imu_from_previous;
  ASSERT_TRUE(joined);
  const auto direct = imu_between(kStepNs, 3 * kStepNs);
  EXPECT_EQ(joined->begin_ns(), kStepNs);
  EXPECT_EQ(joined->end_ns(), 3 * kStepNs);
  EXPECT_LT((joined->delta_position({}) - direct->delta_position({})).norm(), 1e-6);
  EXPECT_LT((joined->delta_velocity({}) - direct->delta_velocity({})).norm(), 1e-6);
  EXPECT_EQ(map.keyframe(KeyframeId(3)).previous, KeyframeId(1));
  EXPECT_EQ(map.keyframe(KeyframeId(1)).next, KeyframeId(3));
  EXPECT_FALSE(map.find_inconsistency());
}

TEST_F(MapOfChain, RemovalNextToAGapLeavesAGap) {
  map.set_imu(KeyframeId(2), nullptr);
  map.remove_keyframe(KeyframeId(2));
  EXPECT_FALSE(map.keyframe(KeyframeId(3)).imu_from_previous);
  EXPECT_FALSE(map.find_inconsistency());
}

TEST_F(MapOfChain, RemovedKeyframesFollowTheirAnchorsThroughChains) {
  for (const std::uint32_t k : {4u, 3u, 2u, 1u}) map.remove_keyframe(KeyframeId(k));
  ASSERT_FALSE(map.find_inconsistency());
  std::vector<SE3> before;
  for (std::uint32_t k = 0; k < 5; ++k) before.push_back(map.T_world_body(KeyframeId(k)));
  NavState moved = map.keyframe(KeyframeId(0)).state;
  const SE3 T_new_old = random_state(rng).T_world_body;
  moved.T_world_body = T_new_old * moved.T_world_body;
  const std::uint64_t version = map.pose_version();
  map.set_state(KeyframeId(0), moved);
  EXPECT_NE(map.pose_version(), version);
  for (std::uint32_t k = 0; k < 5; ++k)
    EXPECT_LT((T_new_old * before[k]).local(map.T_world_body(KeyframeId(k))).norm(), 1e-9) << k;
}

TEST_F(MapOfChain, LandmarksMoveWithTheirAnchorAndOnlyWithIt) {
  const KeyframeId moved_keyframe(3);
  std::vector<Vector3d> before;
  for (const LandmarkId l : landmarks) before.push_back(map.p_world(l));
  NavState moved = map.keyframe(moved_keyframe).state;
  const SE3 T_new_old = random_state(rng).T_world_body;
  moved.T_world_body = T_new_old * moved.T_world_body;
  map.set_state(moved_keyframe, moved);
  int followed = 0;
  for (std::size_t i = 0; i < landmarks.size(); ++i) {
    const bool follows = map.landmark(landmarks[i]).anchor == moved_keyframe;
    followed += follows;
    EXPECT_LT((map.p_world(landmarks[i]) - (follows ? T_new_old * before[i] : before[i])).norm(),
              1e-9);
  }
  EXPECT_GT(followed, 0);
}

TEST_F(MapOfChain, LosingTheAnchorKeepsThePlaceAndTheViewingDirection) {
  const LandmarkId l = landmarks[4];
  ASSERT_GE(map.landmark(l).observations.size(), 2u);
  const Vector3d p = map.p_world(l), normal = map.normal_world(l);
  const KeyframeId anchor = map.landmark(l).anchor;
  map.remove_observation(l, anchor);
  EXPECT_NE(map.landmark(l).anchor, anchor);
  EXPECT_LT((map.p_world(l) - p).norm(), 1e-9);
  EXPECT_LT((map.normal_world(l) - normal).norm(), 1e-5);
}

TEST_F(MapOfChain, TransformTurnsPosesVelocitiesAndLandmarksAlike) {
  map.remove_keyframe(KeyframeId(2));
  const SE3 T = random_state(rng).T_world_body;
  const auto before = map.publish();
  map.transform_map(MapId(0), T);
  for (std::uint32_t k = 0; k < map.keyframe_slots(); ++k)
    EXPECT_LT(
        (T * before->T_world_body(KeyframeId(k))).local(map.T_world_body(KeyframeId(k))).norm(),
        1e-9);
  EXPECT_LT((map.keyframe(KeyframeId(1)).state.v_world -
             T.rotation * before->keyframe(KeyframeId(1)).state.v_world)
                .norm(),
            1e-12);
  for (const LandmarkId l : landmarks)
    if (map.contains(l)) {
      EXPECT_LT((map.p_world(l) - T * before->p_world(l)).norm(), 1e-9);
    }
}

TEST_F(MapOfChain, ResolveFollowsReplacementsToTheirEnd) {
  ASSERT_GE(landmarks.size(), 4u);
  map.replace_landmark(landmarks[0], landmarks[1]);
  map.replace_landmark(landmarks[1], landmarks[2]);
  map.replace_landmark(landmarks[2], landmarks[3]);
  for (int i = 0; i < 4; ++i)
    EXPECT_EQ(map.resolve(landmarks[static_cast<std::size_t>(i)]), landmarks[3]);
  const std::size_t left = map.num_landmarks();
  map.replace_landmark(landmarks[0], landmarks[3]);  // no landmark any more: nothing happens
  EXPECT_EQ(map.num_landmarks(), left);
  map.remove_landmark(landmarks[3]);
  map.remove_landmark(landmarks[3]);
  EXPECT_EQ(map.num_landmarks(), left - 1);
  EXPECT_FALSE(map.resolve(landmarks[0]).valid());
  EXPECT_FALSE(map.resolve(LandmarkId{}).valid());
  EXPECT_FALSE(map.resolve(LandmarkId(1'000'000)).valid());
  EXPECT_FALSE(map.find_inconsistency());
}

TEST_F(MapOfChain, CheckNoticesWhatIsWrong) {
  const Map good = map;
  map.set_parent(KeyframeId(2), KeyframeId(4));
  EXPECT_TRUE(map.find_inconsistency());
  map = good;
  map.set_imu(KeyframeId(2), imu_between(0, kStepNs));
  EXPECT_TRUE(map.find_inconsistency());
  map = good;
  map.mutable_info(MapId(0)).num_keyframes = 3;
  EXPECT_TRUE(map.find_inconsistency());
  map = good;
  map.set_p_world(landmarks[0], Vector3d(NAN, 0, 0));
  EXPECT_TRUE(map.find_inconsistency());
  map = good;
  EXPECT_FALSE(map.find_inconsistency());
}

TEST_F(MapOfChain, RepresentativeDescriptorHasLeastMedianDistance) {
  for (const LandmarkId l : landmarks) {
    const auto& seen = map.landmark(l).observations;
    std::vector<Descriptor> all;
    for (const Observation& o : seen)
      all.push_back(map.keyframe(o.keyframe).data->features->descriptors[o.keypoint]);
    const auto median = [&](const Descriptor& d) {
      std::vector<int> distances;
      for (const Descriptor& other : all) distances.push_back(hamming_distance(d, other));
      std::sort(distances.begin(), distances.end());
      return distances[(distances.size() - 1) / 2];
    };
    map.refresh_landmark(l);
    for (const Descriptor& d : all) EXPECT_LE(median(map.landmark(l).descriptor), median(d));
  }
}

TEST(Map, CheckIsSparseEnoughForTenThousandKeyframes) {
  std::mt19937 rng(3);
  Map map(testing::pinhole_rig(), PyramidScales());
  const MapId id = map.start_map();
  const auto data = random_data(rng, 0);
  std::vector<LandmarkId> recent;
  for (std::uint32_t i = 0; i < 10'000; ++i) {
    const KeyframeId k = map.add_keyframe(id, data, random_state(rng), nullptr);
    for (std::uint32_t p = 0; p < recent.size(); ++p) map.add_observation(recent[p], k, p);
    recent = {map.add_landmark(k, 10, normal_vector(rng, 3)),
              map.add_landmark(k, 11, normal_vector(rng, 3))};
    map.attach_to_spanning_tree(k);
  }
  EXPECT_FALSE(map.find_inconsistency());
}

}  // namespace
}  // namespace fastloop::map
