#include <gtest/gtest.h>

#include <cmath>
#include <functional>

#include "simulated_loop.hpp"

/// Corrections built from corrupted input: refused with a reason, the map as it was.
namespace fastloop::loop {
namespace {

using testing::Attempt;
using testing::small_world;

/// Everything of a map that a correction could change.
struct Fingerprint {
  std::uint64_t version;
  std::vector<double> numbers;
  std::vector<std::size_t> counts;
  bool operator==(const Fingerprint&) const = default;

  explicit Fingerprint(const map::Snapshot& m) : version(m.version()) {
    for (std::uint32_t i = 0; i < m.keyframe_slots(); ++i) {
      const SE3 T = m.T_world_body(KeyframeId(i));
      for (int k = 0; k < 3; ++k) numbers.push_back(T.translation[k]);
      for (int k = 0; k < 4; ++k) numbers.push_back(T.rotation.coeffs()[k]);
      counts.push_back(m.covisible(KeyframeId(i)).size());
      counts.push_back(m.keyframe(KeyframeId(i)).map.value());
    }
    counts.insert(counts.end(), {m.num_landmarks(), m.num_keyframes(), m.loop_edges().size()});
  }
};

struct Corruption {
  const char* name;
  const char* reason;  ///< part of the message
  std::function<void(map::LoopCorrection&, map::Map&)> apply;
};

const double kNan = std::numeric_limits<double>::quiet_NaN();

std::vector<Corruption> corruptions() {
  return {
      {"NaN position", "not finite",
       [](auto& c, auto&) { c.states[4].after.T_world_body.translation.x() = kNan; }},
      {"infinite velocity", "not finite",
       [](auto& c, auto&) { c.states[0].after.v_world.y() = INFINITY; }},
      {"rotation that is none", "not finite",
       [](auto& c, auto&) { c.states[2].after.T_world_body.rotation.coeffs() *= 2; }},
      {"NaN before", "not finite",
       [](auto& c, auto&) { c.states[4].before.T_world_body.translation.x() = kNan; }},
      {"NaN edge", "not finite", [](auto& c, auto&) { c.edge.T_a_b.translation.z() = kNan; }},
      {"unknown keyframe", "does not exist",
       [](auto& c, auto&) { c.states.back().keyframe = KeyframeId(1'000'000); }},
      {"keyframes out of order", "order",
       [](auto& c, auto&) { std::swap(c.states[3], c.states[4]); }},
      {"unknown landmark merged", "cannot be",
       [](auto& c, auto&) { c.merges[0].loser = LandmarkId(90'000'000); }},
      {"invalid winner", "cannot be", [](auto& c, auto&) { c.merges[0].winner = LandmarkId{}; }},
      {"landmark merged with itself", "cannot be",
       [](auto& c, auto&) { c.merges[0].winner = c.merges[0].loser; }},
      {"unknown keypoint", "does not exist",
       [](auto& c, auto&) {
         c.observations.push_back({c.merges[0].winner, c.edge.b, 60'000});
       }},
      {"observation of an unknown landmark", "does not exist",
       [](auto& c, auto&) { c.observations.push_back({LandmarkId(90'000'000), c.edge.b, 0}); }},
      {"unknown map", "map that does not exist", [](auto& c, auto&) { c.map = MapId(7); }},
      {"edge to nowhere", "does not exist",
       [](auto& c, auto&) { c.edge.a = KeyframeId(5'000'000); }},
      {"edge wrong by 10 m", "contradict",
       [](auto& c, auto&) { c.edge.T_a_b.translation.x() += 10; }},
      {"everything wrong by 10 m", "",
       [](auto& c, auto&) {
         // A correction that agrees with its own wrong edge: only the images can tell.
         const SE3 away(Eigen::Quaterniond::Identity(), Vector3d(10, 0, 0));
         const std::size_t half = c.states.size() / 2;
         for (std::size_t i = half; i < c.states.size(); ++i)
           c.states[i].after.T_world_body = away * c.states[i].after.T_world_body;
         const auto state = [&](KeyframeId id) {
           for (const auto& s : c.states)
             if (s.keyframe == id) return s.after.T_world_body;
           return SE3();
         };
         c.edge.T_a_b = state(c.edge.a).inverse() * state(c.edge.b);
       }},
      {"map torn", "reprojection error",
       [](auto& c, auto&) {
         for (std::size_t i = 0; i < c.states.size(); ++i)
           if (c.states[i].keyframe != c.edge.a && c.states[i].keyframe != c.edge.b)
             c.states[i].after.T_world_body.translation.y() += i % 2 ? 0.4 : -0.4;
       }},
      {"computed for a map that was corrected since", "corrected since",
       [](auto&, auto& map) { map.note_frame_change(); }},
      {"keyframe without a path to the loop", "without a path",
       [](auto& c, auto& map) {
         // An island: a keyframe of the same map that nothing joins to the others.
         const map::Keyframe like = map.keyframe(KeyframeId(0));
         const KeyframeId id = map.add_keyframe(c.map, like.data, like.state, nullptr);
         c.states.push_back({id, like.state, like.state});
         c.states.back().after.T_world_body.translation.x() += 1;
       }},
  };
}

TEST(Correction, OfCorruptedInputIsRefusedAndTheMapUntouched) {
  const Attempt origin(small_world(), Backend::kCpu);
  ASSERT_TRUE(origin.outcome.correction.has_value());
  for (const Corruption& corruption : corruptions()) {
    SCOPED_TRACE(corruption.name);
    map::Map map(origin.world.map);
    map::LoopCorrection c = *origin.outcome.correction;
    corruption.apply(c, map);
    const Fingerprint before(map);
    const auto outcome = map::apply_correction(map, c);
    EXPECT_FALSE(outcome.applied);
    EXPECT_NE(outcome.reason.find(corruption.reason), std::string::npos) << outcome.reason;
    EXPECT_TRUE(before == Fingerprint(map));
  }
  // The same correction without harm is applied.
  map::Map map(origin.world.map);
  EXPECT_TRUE(map::apply_correction(map, *origin.outcome.correction).applied);
}

TEST(Correction, AppliesToAMapThatGrewMeanwhile) {
  const Attempt origin(small_world(), Backend::kCpu);
  ASSERT_TRUE(origin.outcome.correction.has_value());
  const map::LoopCorrection& c = *origin.outcome.correction;
  map::Map map(origin.world.map);

  // Meanwhile: a new keyframe, one adjusted, a landmark merged, one removed.
  const KeyframeId last = c.edge.b;
  const auto& newest = map.keyframe(last);
  NavState state = newest.state;
  const SE3 step(so3::exp({0, 0, 0.1}), Vector3d(0.5, 0.1, 0));
  state.T_world_body = state.T_world_body * step;
  state.v_world = Vector3d(1, 2, 3);
  const KeyframeId added = map.add_keyframe(c.map, newest.data, state, nullptr);
  map.attach_to_spanning_tree(added);
  const KeyframeId adjusted(last.value() - 3);
  NavState moved = map.keyframe(adjusted).state;
  const SE3 nudge(so3::exp({0, 0.001, 0}), Vector3d(0.01, 0, 0));
  moved.T_world_body = moved.T_world_body * nudge;
  map.set_state(adjusted, moved);
  map.remove_landmark(c.merges[0].loser);
  map.remove_landmark(c.merges[1].winner);
  const std::size_t landmarks = map.num_landmarks();

  const auto outcome = map::apply_correction(map, c);
  ASSERT_TRUE(outcome.applied) << outcome.reason;
  EXPECT_EQ(map.find_inconsistency(), std::nullopt);
  EXPECT_LT(map.num_landmarks(), landmarks);

  // The new keyframe keeps its place relative to the last one that was corrected.
  const SE3 relative = map.T_world_body(last).inverse() * map.T_world_body(added);
  EXPECT_LT((relative.translation - step.translation).norm(), 1e-9);
  EXPECT_LT(angle_between(relative, step), 1e-9);
  // Its velocity turns with it.
  const Eigen::Quaterniond turn =
      map.T_world_body(added).rotation * state.T_world_body.rotation.conjugate();
  EXPECT_LT((map.keyframe(added).state.v_world - turn * state.v_world).norm(), 1e-9);
  // The adjusted one keeps the adjustment: the correction moves it rigidly.
  for (const auto& s : c.states)
    if (s.keyframe == adjusted) {
      const SE3 expected = s.after.T_world_body * s.before.T_world_body.inverse() * moved.T_world_body;
      EXPECT_LT((expected.translation - map.T_world_body(adjusted).translation).norm(), 1e-9);
    }
}

TEST(Correction, AtAKeyframeThatWasRemovedMeanwhile) {
  const Attempt origin(small_world(), Backend::kCpu);
  const map::LoopCorrection& c = *origin.outcome.correction;
  map::Map map(origin.world.map);
  const KeyframeId gone(c.edge.b.value() - 4);
  const SE3 to_anchor = map.T_world_body(map.keyframe(gone).parent).inverse() * map.T_world_body(gone);
  map.remove_keyframe(gone);
  ASSERT_TRUE(map::apply_correction(map, c).applied);
  EXPECT_EQ(map.find_inconsistency(), std::nullopt);
  const SE3 now = map.T_world_body(map.keyframe(gone).anchor_of_removed).inverse() * map.T_world_body(gone);
  EXPECT_LT((now.translation - to_anchor.translation).norm(), 1e-9);
}

TEST(Correction, OfAWrongMatchIsRefused) {
  // The whole computation with a match that is wrong by ten metres: nothing of it fits the images.
  const Attempt origin(small_world(), Backend::kCpu);
  const map::LoopCorrection& c = *origin.outcome.correction;
  const auto snapshot = origin.world.map.publish();
  RegionMatch match;
  match.current = c.edge.b;
  match.matched = c.edge.a;
  SE3 wrong = snapshot->T_world_body(c.edge.a) * c.edge.T_a_b;
  wrong.translation.x() += 10;
  match.T_camera_world = (wrong * snapshot->rig().T_body_left).inverse();
  match.landmarks.assign(snapshot->keyframe(match.current).landmarks.size(), LandmarkId{});
  std::size_t i = 0;
  for (const LandmarkId l : snapshot->keyframe(match.matched).landmarks)
    if (l.valid() && i < match.landmarks.size()) match.landmarks[i++] = l;
  CorrectionMemory memory;
  StageClock clock;
  map::Map map(origin.world.map);
  const Fingerprint before(map);
  const auto outcome = map::apply_correction(
      map, compute_correction(*snapshot, match, {}, executors_of(Backend::kCpu), memory, clock));
  EXPECT_FALSE(outcome.applied);
  EXPECT_FALSE(outcome.reason.empty());
  EXPECT_TRUE(before == Fingerprint(map));
}

}  // namespace
}  // namespace fastloop::loop
