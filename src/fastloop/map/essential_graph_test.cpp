#include "fastloop/map/essential_graph.hpp"

#include <gtest/gtest.h>

#include <map>
#include <set>

#include "fastloop/core/error.hpp"
#include "fastloop/map/ring_map_for_tests.hpp"

namespace fastloop::map {
namespace {

using optimization::PoseGraphEdge;
using optimization::PoseGraphKind;
using testing::ring_loop;
using testing::ring_map;
using testing::ring_truth;
using testing::RingMapOptions;

using Pair = std::pair<std::uint32_t, std::uint32_t>;  // later keyframe first

Pair pair_of(KeyframeId a, KeyframeId b) {
  return {std::max(a.value(), b.value()), std::min(a.value(), b.value())};
}

std::map<Pair, PoseGraphEdge> edges_of(const EssentialGraph& graph) {
  std::map<Pair, PoseGraphEdge> edges;
  for (const PoseGraphEdge& e : graph.problem.edges) {
    const KeyframeId a = graph.keyframe_of_vertex[static_cast<std::size_t>(e.from)];
    const KeyframeId b = graph.keyframe_of_vertex[static_cast<std::size_t>(e.to)];
    EXPECT_TRUE(edges.emplace(pair_of(a, b), e).second)
        << "twice: " << a.value() << " " << b.value();
  }
  return edges;
}

/// The rules once more, over all pairs, without regard to speed.
std::set<Pair> expected_pairs(const Snapshot& map, const ClosedLoop& loop,
                              const EssentialGraphOptions& options) {
  std::set<Pair> pairs;
  const auto add = [&](KeyframeId a, KeyframeId b) {
    if (a.valid() && b.valid() && map.contains(a) && map.contains(b)) pairs.insert(pair_of(a, b));
  };
  add(loop.edge.a, loop.edge.b);
  for (const LoopConnection& c : loop.connections)
    if (c.shared >= options.min_shared) add(c.a, c.b);
  for (const LoopEdge& e : map.loop_edges()) add(e.a, e.b);
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
    const KeyframeId id(i);
    const Keyframe& k = map.keyframe(id);
    if (k.removed) continue;
    for (const CovisibilityEdge& e : map.covisible(id))
      if (e.shared >= options.min_shared) add(id, e.keyframe);
    if (k.imu_from_previous) add(id, k.previous);
    if (options.kind != PoseGraphKind::kYaw || !k.imu_from_previous) add(id, k.parent);
  }
  return pairs;
}

RingMapOptions ring_of(int keyframes) {
  RingMapOptions options;
  options.keyframes = keyframes;
  return options;
}

class EssentialGraphs : public ::testing::TestWithParam<PoseGraphKind> {};
INSTANTIATE_TEST_SUITE_P(All, EssentialGraphs,
                         ::testing::Values(PoseGraphKind::kYaw, PoseGraphKind::kSe3,
                                           PoseGraphKind::kSim3),
                         [](const auto& test) {
                           return std::string(test.param == PoseGraphKind::kYaw   ? "Yaw"
                                              : test.param == PoseGraphKind::kSe3 ? "Se3"
                                                                                  : "Sim3");
                         });

TEST_P(EssentialGraphs, HasTheEdgesOfTheRules) {
  Map map = ring_map(ring_of(60));
  for (std::uint32_t removed : {7u, 8u, 30u, 41u}) map.remove_keyframe(KeyframeId(removed));
  map.add_loop_edge({KeyframeId(2), KeyframeId(25), SE3()});
  map.add_loop_edge({KeyframeId(30), KeyframeId(5), SE3()});  // an end was removed
  map.set_parent(KeyframeId(12), KeyframeId(3));
  map.set_parent(KeyframeId(20), KeyframeId(33));  // a parent may be the later keyframe
  map.set_imu(KeyframeId(20), nullptr);
  map.set_imu(KeyframeId(50), nullptr);
  const ClosedLoop loop = ring_loop(map);
  EssentialGraphOptions options;
  options.kind = GetParam();
  options.min_shared = 140;
  EssentialGraph graph;
  build_essential_graph(map, MapId(0), loop, options, graph);

  const auto edges = edges_of(graph);
  std::set<Pair> found;
  for (const auto& [pair, edge] : edges) found.insert(pair);
  EXPECT_EQ(found, expected_pairs(map, loop, options));
  EXPECT_EQ(graph.problem.poses.size(), map.num_keyframes());
  for (std::size_t v = 0; v < graph.keyframe_of_vertex.size(); ++v) {
    EXPECT_TRUE(map.contains(graph.keyframe_of_vertex[v]));
    EXPECT_EQ(graph.vertex_of_keyframe[graph.keyframe_of_vertex[v].value()], static_cast<int>(v));
    EXPECT_EQ(graph.problem.fixed[v], graph.keyframe_of_vertex[v] == KeyframeId(0));
  }
  EXPECT_EQ(graph.vertex_of_keyframe[30], -1);
  EXPECT_TRUE(edges.at({25, 2}).switchable);
  EXPECT_TRUE(edges.at({59, 0}).switchable);
  EXPECT_FALSE(edges.at({1, 0}).switchable);
}

/// The problem of a map that grew begins with that of the map before, so that a kept plan can be
/// extended.
TEST_P(EssentialGraphs, GrowsAtTheEnd) {
  EssentialGraphOptions options;
  options.kind = GetParam();
  EssentialGraph small, large;
  const Map before = ring_map(ring_of(55)), after = ring_map(ring_of(60));
  build_essential_graph(before, MapId(0), ring_loop(before), options, small);
  build_essential_graph(after, MapId(0), ring_loop(after), options, large);
  const auto& a = small.problem.edges;
  const auto& b = large.problem.edges;
  ASSERT_LT(a.size(), b.size());
  std::size_t same = 0;
  while (same < a.size() && a[same].from == b[same].from && a[same].to == b[same].to) ++same;
  EXPECT_EQ(a[same].from, 51);  // the first that the smaller map's own loop touches
}

TEST_P(EssentialGraphs, MeasurementsComeFromTheRightPoses) {
  const Map map = ring_map(ring_of(50));
  ClosedLoop loop = ring_loop(map);
  loop.edge.T_a_b = loop.edge.T_a_b * SE3(so3::exp({0, 0, 0.01}), Vector3d(0.1, 0, 0));
  EssentialGraphOptions options;
  options.kind = GetParam();
  EssentialGraph graph;
  build_essential_graph(map, MapId(0), loop, options, graph);
  std::map<KeyframeId, SE3> corrected;
  for (const CorrectedPose& c : loop.corrected) corrected[c.keyframe] = c.T_world_body;
  const auto pose = [&](KeyframeId id, bool moved) {
    return moved && corrected.contains(id) ? corrected[id] : map.T_world_body(id);
  };
  std::set<Pair> connections;
  for (const LoopConnection& c : loop.connections) connections.insert(pair_of(c.a, c.b));
  int measured = 0, connected = 0;
  for (const auto& [pair, e] : edges_of(graph)) {
    const KeyframeId from = graph.keyframe_of_vertex[static_cast<std::size_t>(e.from)];
    const KeyframeId to = graph.keyframe_of_vertex[static_cast<std::size_t>(e.to)];
    SE3 expected;
    if (pair == pair_of(loop.edge.a, loop.edge.b)) {
      expected = from == loop.edge.a ? loop.edge.T_a_b : loop.edge.T_a_b.inverse();
      ++measured;
    } else {
      const bool moved = connections.contains(pair);
      expected = pose(from, moved).inverse() * pose(to, moved);
      connected += moved;
    }
    EXPECT_LT(expected.local(e.T_from_to.rigid()).norm(), 1e-9) << pair.first << " " << pair.second;
  }
  EXPECT_EQ(measured, 1);
  EXPECT_EQ(connected, 4 * 3 - 1);  // the four latest share enough, one pair is the measured one
}

TEST(EssentialGraph, HoldsOneMapOnly) {
  Map map = ring_map(ring_of(20));
  const MapId second = map.start_map();
  NavState state;
  std::vector<KeyframeId> added;
  for (int i = 0; i < 6; ++i) {
    auto data = std::make_shared<KeyframeData>(*map.keyframe(KeyframeId(0)).data);
    data->stamp_ns = 10'000'000'000LL + i;
    state.T_world_body.translation = Vector3d(i, 50, 0);
    added.push_back(map.add_keyframe(second, data, state, nullptr));
    map.attach_to_spanning_tree(added.back());
  }
  ClosedLoop loop;
  loop.edge = {KeyframeId(0), KeyframeId(19),
               SE3(Eigen::Quaterniond::Identity(), Vector3d(0, -1, 0))};
  loop.fixed = KeyframeId(0);
  EssentialGraph graph;
  build_essential_graph(map, MapId(0), loop, {}, graph);
  EXPECT_EQ(graph.problem.poses.size(), 20u);
  EXPECT_EQ(graph.vertex_of_keyframe[added[0].value()], -1);
  EXPECT_THROW(build_essential_graph(map, second, loop, {}, graph), InvalidArgument);
  loop.edge = {added[0], added[5], SE3(Eigen::Quaterniond::Identity(), Vector3d(5, 0, 0))};
  loop.fixed = added[0];
  build_essential_graph(map, second, loop, {}, graph);
  EXPECT_EQ(graph.keyframe_of_vertex, added);
  EXPECT_EQ(graph.problem.edges.size(),
            6u);  // the tree, for want of IMU measurements, and the loop
}

TEST(EssentialGraph, YawKeepsAMapInOnePiece) {
  Map map = ring_map(ring_of(20));
  // Keyframe 10 has no predecessor and hangs on a later one; only the tree edge of 14 leads across.
  map.set_imu(KeyframeId(10), nullptr);
  map.set_parent(KeyframeId(10), KeyframeId(15));
  map.set_parent(KeyframeId(14), KeyframeId(3));
  ClosedLoop loop;
  loop.edge = {KeyframeId(0), KeyframeId(9),
               SE3(Eigen::Quaterniond::Identity(), Vector3d(5, 0, 0))};
  loop.fixed = KeyframeId(0);
  EssentialGraphOptions options;
  options.min_shared = 100000;  // nobody is covisible
  EssentialGraph graph;
  build_essential_graph(map, MapId(0), loop, options, graph);
  const auto edges = edges_of(graph);
  EXPECT_EQ(edges.size(), 1u + 18u + 2u);  // the loop, neighbours in time, two edges of the tree
  EXPECT_TRUE(edges.contains({15, 10}));
  EXPECT_TRUE(edges.contains({14, 3}));
  EXPECT_FALSE(edges.contains({10, 9}));
  const auto result = optimization::solve_pose_graph(graph.problem);
  EXPECT_EQ(result.components, 1);
  EXPECT_EQ(result.anchored, 0);
}

TEST(EssentialGraph, RefusesWhatIsNotInTheMap) {
  const Map map = ring_map(ring_of(20));
  const ClosedLoop good = ring_loop(map);
  EssentialGraph graph;
  ClosedLoop loop = good;
  loop.fixed = KeyframeId();
  EXPECT_THROW(build_essential_graph(map, MapId(0), loop, {}, graph), InvalidArgument);
  loop = good;
  loop.edge.b = KeyframeId(20);
  EXPECT_THROW(build_essential_graph(map, MapId(0), loop, {}, graph), InvalidArgument);
  loop = good;
  loop.edge.b = loop.edge.a;
  EXPECT_THROW(build_essential_graph(map, MapId(0), loop, {}, graph), InvalidArgument);
  loop = good;
  loop.corrected.push_back({KeyframeId(99), SE3()});
  EXPECT_THROW(build_essential_graph(map, MapId(0), loop, {}, graph), InvalidArgument);
  loop = good;
  loop.connections.push_back({KeyframeId(1), KeyframeId(99), 200});
  EXPECT_THROW(build_essential_graph(map, MapId(0), loop, {}, graph), InvalidArgument);
  build_essential_graph(map, MapId(0), good, {}, graph);
}

/// The whole way: a drifted ring, the graph, the solve, and back into the map.
TEST_P(EssentialGraphs, ClosesARing) {
  const int n = 80;
  Map map = ring_map(ring_of(n));
  map.remove_keyframe(KeyframeId(33));
  const Snapshot before = map;
  const ClosedLoop loop = ring_loop(map);
  const auto gap = [&] {
    return (map.T_world_body(KeyframeId(0)).inverse() * map.T_world_body(KeyframeId(n - 1)))
        .local(loop.edge.T_a_b)
        .norm();
  };
  EXPECT_GT(gap(), 1.0);
  EssentialGraphOptions options;
  options.kind = GetParam();
  EssentialGraph graph;
  build_essential_graph(map, MapId(0), loop, options, graph);
  const auto result = optimization::solve_pose_graph(graph.problem);
  EXPECT_EQ(result.status, optimization::PoseGraphStatus::kConverged);
  EXPECT_EQ(result.components, 1);
  take_back(graph, map);
  EXPECT_LT(gap(), 0.1);
  EXPECT_EQ(map.find_inconsistency(), std::nullopt);
  for (int i = 0; i < n; ++i) {
    const KeyframeId id(static_cast<std::uint32_t>(i));
    EXPECT_LT((map.T_world_body(id).translation - ring_truth(i, n).translation).norm(), 2.0) << i;
    if (!map.contains(id)) continue;
    const NavState& state = map.keyframe(id).state;
    EXPECT_LT((state.T_world_body.rotation.conjugate() * state.v_world - Vector3d(1, 0, 0)).norm(),
              1e-9);
  }
  // Landmarks keep their place relative to their anchors.
  for (std::uint32_t l = 0; l < map.landmark_slots(); l += 97) {
    const LandmarkId id(l);
    if (!map.contains(id)) continue;
    const SE3 moved = map.T_world_body(map.landmark(id).anchor) *
                      before.T_world_body(before.landmark(id).anchor).inverse();
    EXPECT_LT((map.p_world(id) - moved * before.p_world(id)).norm(), 1e-9);
  }
}

}  // namespace
}  // namespace fastloop::map
