#include "fastloop/io/map_export.hpp"

#include <algorithm>
#include <array>
#include <cstdio>
#include <fstream>
#include <utility>

#include "fastloop/core/error.hpp"

namespace fastloop::io {
namespace {

using Colour = std::array<int, 3>;
constexpr Colour kLandmarkColour{160, 160, 160};
constexpr std::array<Colour, 4> kMapColours{
    {{220, 50, 40}, {40, 110, 220}, {40, 170, 80}, {230, 150, 30}}};

void add_vertex(std::string& text, const Vector3d& p, const Colour& c) {
  char line[128];
  std::snprintf(line, sizeof line, "%.4f %.4f %.4f %d %d %d\n", p.x(), p.y(), p.z(), c[0], c[1],
                c[2]);
  text += line;
}

/// Adds each pair of keyframes once.
class GraphBuilder {
 public:
  explicit GraphBuilder(const map::Snapshot& map)
      : map_(map), vertex_(map.keyframe_slots(), -1), joined_(map.keyframe_slots()) {
    optimization::PoseGraphProblem& p = graph.problem;
    p.kind = optimization::PoseGraphKind::kSe3;
    for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
      const KeyframeId id(i);
      if (!map.contains(id)) continue;
      vertex_[i] = static_cast<int>(graph.ids.size());
      graph.ids.push_back(i);
      p.poses.emplace_back(map.T_world_body(id));
      p.fixed.push_back(map.map_info(map.keyframe(id).map).first_keyframe == id);
    }
  }

  void add(KeyframeId a, KeyframeId b) {
    if (map_.contains(a) && map_.contains(b))
      add(a, b, map_.T_world_body(a).inverse() * map_.T_world_body(b), false);
  }

  void add(KeyframeId a, KeyframeId b, const SE3& T_a_b, bool loop) {
    if (!map_.contains(a) || !map_.contains(b) || a == b) return;
    auto& joined = joined_[std::max(a, b).value()];
    const KeyframeId older = std::min(a, b);
    if (std::find(joined.begin(), joined.end(), older) != joined.end()) return;
    joined.push_back(older);
    optimization::PoseGraphEdge edge;
    edge.from = vertex_[a.value()];
    edge.to = vertex_[b.value()];
    edge.T_from_to = Sim3(T_a_b);
    edge.switchable = loop;
    graph.problem.edges.push_back(edge);
  }

  G2oGraph graph;

 private:
  const map::Snapshot& map_;
  std::vector<int> vertex_;
  std::vector<std::vector<KeyframeId>> joined_;
};

}  // namespace

void export_map_ply(const std::filesystem::path& path, const map::Snapshot& map) {
  std::string body;
  for (std::uint32_t i = 0; i < map.landmark_slots(); ++i)
    if (map.contains(LandmarkId(i))) add_vertex(body, map.p_world(LandmarkId(i)), kLandmarkColour);
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i)
    if (map.contains(KeyframeId(i)))
      add_vertex(body, map.T_world_body(KeyframeId(i)).translation,
                 kMapColours[map.keyframe(KeyframeId(i)).map.value() % kMapColours.size()]);
  std::ofstream out(path, std::ios::binary);
  out << "ply\nformat ascii 1.0\ncomment landmarks grey, then keyframes, metres, world frame\n"
      << "element vertex " << map.num_landmarks() + map.num_keyframes()
      << "\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"
      << "property uchar green\nproperty uchar blue\nend_header\n"
      << body;
  out.close();
  if (!out) throw InputError({path.string(), 0, ""}, "cannot be written");
}

G2oGraph essential_g2o(const map::Snapshot& map, int min_shared) {
  GraphBuilder builder(map);
  for (const map::LoopEdge& e : map.loop_edges()) builder.add(e.a, e.b, e.T_a_b, true);
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
    const KeyframeId id(i);
    if (!map.contains(id)) continue;
    builder.add(map.keyframe(id).parent, id);
    for (const map::CovisibilityEdge& e : map.covisible(id))
      if (e.keyframe < id && e.shared >= min_shared) builder.add(e.keyframe, id);
  }
  return std::move(builder.graph);
}

}  // namespace fastloop::io
