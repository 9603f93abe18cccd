#include "fastloop/optimization/pose_graph_essential.hpp"

#include <algorithm>
#include <unordered_set>

#include "fastloop/core/error.hpp"

namespace fastloop::optimization {

PoseGraphProblem build_essential_graph_problem(PoseGraphKind kind, bool fixed_scale,
                                               std::span<const Sim3> uncorrected,
                                               std::span<const Sim3> corrected, const EssentialGraph& graph,
                                               int fixed) {
  const int n = static_cast<int>(corrected.size());
  if (uncorrected.size() != corrected.size())
    throw InvalidArgument("essential graph: corrected and uncorrected poses differ in number");
  if (fixed < -1 || fixed >= n) throw InvalidArgument("essential graph: the fixed keyframe does not exist");
  PoseGraphProblem problem;
  problem.kind = kind;
  problem.fixed_scale = fixed_scale;
  problem.poses.assign(corrected.begin(), corrected.end());
  problem.fixed.assign(corrected.size(), 0);
  if (fixed >= 0) problem.fixed[fixed] = 1;
  problem.information = {kind == PoseGraphKind::kYaw ? published_yaw_information()
                                                     : PoseGraphInformation::Identity()};
  std::unordered_set<std::uint64_t> known;
  const auto add = [&](const std::vector<std::pair<int, int>>& pairs, std::span<const Sim3> poses, bool loop) {
    for (const auto& [from, to] : pairs) {
      if (from < 0 || from >= n || to < 0 || to >= n || from == to)
        throw InvalidArgument("essential graph: an edge joins keyframes that do not exist or are the same");
      const std::uint64_t low = static_cast<std::uint64_t>(std::min(from, to));
      const std::uint64_t high = static_cast<std::uint64_t>(std::max(from, to));
      if (!known.insert(low << 32 | high).second) continue;
      problem.edges.push_back({from, to, poses[from].inverse() * poses[to], 0, loop});
    }
  };
  add(graph.new_loops, corrected, true);
  add(graph.old_loops, uncorrected, true);
  add(graph.chain, uncorrected, false);
  add(graph.parent, uncorrected, false);
  add(graph.covisible, uncorrected, false);
  return problem;
}

}  // namespace fastloop::optimization
