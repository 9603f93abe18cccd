#include "fastloop/map/essential_graph.hpp"

#include <algorithm>
#include <numeric>

#include "fastloop/core/error.hpp"

namespace fastloop::map {
namespace {

using optimization::PoseGraphEdge;
using optimization::PoseGraphInformation;
using optimization::PoseGraphKind;
using optimization::PoseGraphProblem;

/// An edge of a keyframe towards an earlier one. Of several between the same two the first source
/// wins.
struct Candidate {
  enum Source : int { kMeasured, kConnection, kOldLoop, kMap };
  int to = 0;
  Source source = kMap;
};

/// An edge that does not follow from the keyframe itself; `high` is the later vertex.
struct Extra {
  int high = 0;
  Candidate candidate;
};

class Builder {
 public:
  Builder(const Snapshot& snapshot, const ClosedLoop& loop, const EssentialGraphOptions& options,
          EssentialGraph& graph)
      : snapshot_(snapshot),
        loop_(loop),
        options_(options),
        graph_(graph),
        problem_(graph.problem) {}

  void run(MapId map) {
    add_vertices(map);
    collect_extras();
    component_.resize(uncorrected_.size());
    std::iota(component_.begin(), component_.end(), 0);
    problem_.edges.clear();
    problem_.edges.reserve(uncorrected_.size() * 6);
    auto extra = extras_.begin();
    for (int v = 0; v < static_cast<int>(uncorrected_.size()); ++v) {
      candidates_.clear();
      for (; extra != extras_.end() && extra->high == v; ++extra)
        candidates_.push_back(extra->candidate);
      collect(v);
      add_candidates(v);
    }
    if (options_.kind == PoseGraphKind::kYaw) join_components();
  }

 private:
  void add_vertices(MapId map) {
    map = snapshot_.resolve(map);
    const std::size_t slots = snapshot_.keyframe_slots();
    graph_.keyframe_of_vertex.clear();
    graph_.vertex_of_keyframe.assign(slots, -1);
    problem_.poses.clear();
    for (std::uint32_t i = 0; i < slots; ++i) {
      const Keyframe& k = snapshot_.keyframe(KeyframeId(i));
      if (k.removed || snapshot_.resolve(k.map) != map) continue;
      graph_.vertex_of_keyframe[i] = static_cast<int>(graph_.keyframe_of_vertex.size());
      graph_.keyframe_of_vertex.push_back(KeyframeId(i));
      problem_.poses.emplace_back(k.state.T_world_body);
    }
    uncorrected_ = problem_.poses;
    for (const CorrectedPose& c : loop_.corrected)
      problem_.poses[required(c.keyframe)] = Sim3(c.T_world_body);
    problem_.kind = options_.kind;
    problem_.fixed_scale = options_.fixed_scale;
    problem_.fixed.assign(uncorrected_.size(), 0);
    problem_.fixed[required(loop_.fixed)] = 1;
    problem_.information.assign(1, options_.kind == PoseGraphKind::kYaw
                                       ? optimization::published_yaw_information()
                                       : PoseGraphInformation::Identity());
  }

  int vertex(KeyframeId id) const {
    return id.value() < graph_.vertex_of_keyframe.size() ? graph_.vertex_of_keyframe[id.value()]
                                                         : -1;
  }
  std::size_t required(KeyframeId id) const {
    const int v = vertex(id);
    if (v < 0)
      throw InvalidArgument("essential graph: the loop names a keyframe that is not in the map");
    return static_cast<std::size_t>(v);
  }

  void collect_extras() {
    const auto add = [&](int a, int b, Candidate::Source source) {
      if (a != b) extras_.push_back({std::max(a, b), {std::min(a, b), source}});
    };
    const auto add_required = [&](KeyframeId a, KeyframeId b, Candidate::Source source) {
      add(static_cast<int>(required(a)), static_cast<int>(required(b)), source);
    };
    if (loop_.edge.a == loop_.edge.b)
      throw InvalidArgument("essential graph: the loop joins a keyframe to itself");
    add_required(loop_.edge.a, loop_.edge.b, Candidate::kMeasured);
    for (const LoopConnection& c : loop_.connections)
      if (c.shared >= options_.min_shared) add_required(c.a, c.b, Candidate::kConnection);
    for (const LoopEdge& e : snapshot_.loop_edges())
      if (const int a = vertex(e.a), b = vertex(e.b); a >= 0 && b >= 0)
        add(a, b, Candidate::kOldLoop);
    // A tree does not say which end is the earlier keyframe.
    for (std::size_t v = 0; v < uncorrected_.size(); ++v)
      if (const int p = vertex(keyframe(v).parent);
          p > static_cast<int>(v) && takes_parent(keyframe(v)))
        add(static_cast<int>(v), p, Candidate::kMap);
    std::stable_sort(extras_.begin(), extras_.end(),
                     [](const Extra& a, const Extra& b) { return a.high < b.high; });
  }

  const Keyframe& keyframe(std::size_t v) const {
    return snapshot_.keyframe(graph_.keyframe_of_vertex[v]);
  }

  bool takes_parent(const Keyframe& k) const {
    return options_.kind != PoseGraphKind::kYaw || !k.imu_from_previous;
  }

  /// Edges to earlier keyframes that follow from the map.
  void collect(int v) {
    const auto add = [&](int to) {
      if (to >= 0 && to < v) candidates_.push_back({to, Candidate::kMap});
    };
    const Keyframe& k = keyframe(static_cast<std::size_t>(v));
    if (takes_parent(k)) add(vertex(k.parent));
    if (k.imu_from_previous) add(vertex(k.previous));
    for (const CovisibilityEdge& e :
         snapshot_.covisible(graph_.keyframe_of_vertex[static_cast<std::size_t>(v)])) {
      if (e.shared >= options_.min_shared) add(vertex(e.keyframe));
    }
  }

  void add_candidates(int v) {
    std::sort(candidates_.begin(), candidates_.end(), [](const Candidate& a, const Candidate& b) {
      return a.to != b.to ? a.to < b.to : a.source < b.source;
    });
    int last = -1;
    for (const Candidate& c : candidates_) {
      if (c.to == last) continue;
      last = c.to;
      add_edge(v, c);
    }
  }

  void add_edge(int v, const Candidate& c) {
    const auto from = static_cast<std::size_t>(v), to = static_cast<std::size_t>(c.to);
    PoseGraphEdge e;
    e.from = v;
    e.to = c.to;
    e.switchable = c.source != Candidate::kMap;
    if (c.source == Candidate::kMeasured) {
      const bool forward = graph_.keyframe_of_vertex[from] == loop_.edge.a;
      e.T_from_to = Sim3(forward ? loop_.edge.T_a_b : loop_.edge.T_a_b.inverse());
    } else {
      const std::vector<Sim3>& poses =
          c.source == Candidate::kConnection ? problem_.poses : uncorrected_;
      e.T_from_to = poses[from].inverse() * poses[to];
    }
    problem_.edges.push_back(e);
    if (const int a = find_root(v), b = find_root(c.to); a != b)
      component_[static_cast<std::size_t>(a)] = b;
  }

  int find_root(int v) {
    while (component_[static_cast<std::size_t>(v)] != v) {
      int& up = component_[static_cast<std::size_t>(v)];
      v = up = component_[static_cast<std::size_t>(up)];
    }
    return v;
  }

  /// Tree edges without which the graph would fall apart.
  void join_components() {
    for (int v = 0; v < static_cast<int>(uncorrected_.size()); ++v) {
      const int parent = vertex(keyframe(static_cast<std::size_t>(v)).parent);
      if (parent >= 0 && find_root(v) != find_root(parent)) add_edge(v, {parent, Candidate::kMap});
    }
  }

  const Snapshot& snapshot_;
  const ClosedLoop& loop_;
  const EssentialGraphOptions& options_;
  EssentialGraph& graph_;
  PoseGraphProblem& problem_;
  std::vector<Sim3> uncorrected_;
  std::vector<Extra> extras_;
  std::vector<Candidate> candidates_;
  std::vector<int> component_;
};

}  // namespace

void build_essential_graph(const Snapshot& snapshot, MapId map, const ClosedLoop& loop,
                           const EssentialGraphOptions& options, EssentialGraph& graph) {
  Builder(snapshot, loop, options, graph).run(map);
}

NavState corrected_state(const Snapshot& snapshot, const EssentialGraph& graph,
                         std::size_t vertex) {
  NavState state = snapshot.keyframe(graph.keyframe_of_vertex[vertex]).state;
  const SE3 pose = graph.problem.poses[vertex].rigid();
  state.v_world = pose.rotation * (state.T_world_body.rotation.conjugate() * state.v_world);
  state.T_world_body = pose;
  return state;
}

void take_back(const EssentialGraph& graph, Map& map) {
  for (std::size_t v = 0; v < graph.keyframe_of_vertex.size(); ++v)
    map.set_state(graph.keyframe_of_vertex[v], corrected_state(map, graph, v));
}

}  // namespace fastloop::map
