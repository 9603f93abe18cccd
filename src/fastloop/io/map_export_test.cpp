#include "fastloop/io/map_export.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <map>
#include <set>

#include "fastloop/core/error.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

class MapExport : public ::testing::Test {
 protected:
  MapExport() : world_(400, {6, 6, 3}, 1), synthetic_(world_) {
    std::mt19937 rng(1);
    for (int i = 0; i < 10; ++i)
      synthetic_.add(map::testing::pose_at({0.2 * i, 0, 0}, 0.02 * i), {}, rng);
    synthetic_.map.remove_keyframe(KeyframeId(4));
    loop_.translation = {1, 2, 3};
    synthetic_.map.add_loop_edge({KeyframeId(1), KeyframeId(9), loop_});
    synthetic_.map.add_loop_edge({KeyframeId(4), KeyframeId(8), loop_});  // an end is gone
  }
  const map::Map& map() const { return synthetic_.map; }
  fs::path file(const char* name) const {
    return fs::path(::testing::TempDir()) / (std::to_string(::getpid()) + name);
  }

  map::testing::SyntheticWorld world_;
  map::testing::SyntheticMap synthetic_;
  SE3 loop_;
};

TEST_F(MapExport, GraphHasTreeCovisibleAndLoopEdgesOnce) {
  std::vector<int> shared;
  for (std::uint32_t i = 0; i < 10; ++i)
    for (const auto& e : map().covisible(KeyframeId(i))) shared.push_back(e.shared);
  std::sort(shared.begin(), shared.end());
  const int min_shared = shared.at(shared.size() / 2);  // half of the pairs
  const G2oGraph graph = essential_g2o(map(), min_shared);
  EXPECT_EQ(graph.ids.size(), 9u);
  EXPECT_EQ(graph.problem.fixed[0], 1);
  std::map<std::pair<std::int64_t, std::int64_t>, int> edges;
  for (const auto& e : graph.problem.edges) {
    const std::int64_t a = graph.ids[e.from], b = graph.ids[e.to];
    ++edges[{std::min(a, b), std::max(a, b)}];
    const auto id = [](std::int64_t i) { return KeyframeId(static_cast<std::uint32_t>(i)); };
    const SE3 expected =
        e.switchable ? loop_ : map().T_world_body(id(a)).inverse() * map().T_world_body(id(b));
    EXPECT_LT((expected.translation - e.T_from_to.translation).norm(), 1e-12);
  }
  std::set<std::pair<std::int64_t, std::int64_t>> wanted{{1, 9}};
  for (std::uint32_t i = 0; i < 10; ++i) {
    if (!map().contains(KeyframeId(i))) continue;
    if (map().keyframe(KeyframeId(i)).parent.valid())
      wanted.insert({map().keyframe(KeyframeId(i)).parent.value(), i});
    for (const auto& e : map().covisible(KeyframeId(i)))
      if (e.shared >= min_shared)
        wanted.insert({std::min(e.keyframe.value(), i), std::max(e.keyframe.value(), i)});
  }
  EXPECT_GT(wanted.size(), 12u);
  EXPECT_EQ(edges.size(), wanted.size());
  for (const auto& [pair, count] : edges) {
    EXPECT_EQ(count, 1);
    EXPECT_TRUE(wanted.contains(pair)) << pair.first << " " << pair.second;
  }
  write_g2o(file(".g2o"), graph);
  const G2oGraph read = read_g2o(file(".g2o"), 6);
  EXPECT_EQ(read.ids, graph.ids);
  EXPECT_EQ(read.problem.edges.size(), graph.problem.edges.size());
  fs::remove(file(".g2o"));
}

TEST_F(MapExport, PlyHasEveryLandmarkAndKeyframe) {
  export_map_ply(file(".ply"), map());
  std::ifstream in(file(".ply"));
  std::string line;
  std::size_t declared = 0, coloured = 0, lines = 0;
  while (std::getline(in, line) && line != "end_header")
    if (line.starts_with("element vertex ")) declared = std::stoul(line.substr(15));
  while (std::getline(in, line)) {
    ++lines;
    coloured += !line.ends_with(" 160 160 160");
  }
  EXPECT_EQ(declared, map().num_landmarks() + map().num_keyframes());
  EXPECT_EQ(lines, declared);
  EXPECT_EQ(coloured, map().num_keyframes());
  fs::remove(file(".ply"));
  EXPECT_THROW(export_map_ply(file("") / "no" / "such", map()), InputError);
}

}  // namespace
}  // namespace fastloop::io
