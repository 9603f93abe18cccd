#include <algorithm>
#include <chrono>

#include "fastloop/core/time.hpp"
#include "fastloop/optimization/block_solver.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {
namespace {

block::EdgeModel model_of(const PoseGraphProblem& problem) {
  switch (problem.kind) {
    case PoseGraphKind::kYaw:
      return block::EdgeModel::kYaw;
    case PoseGraphKind::kSe3:
      return block::EdgeModel::kSe3;
    case PoseGraphKind::kSim3:
      break;
  }
  return problem.fixed_scale ? block::EdgeModel::kSim3FixedScale : block::EdgeModel::kSim3;
}

constexpr std::size_t kChunk = 512;

bool fixed_at(const PoseGraphProblem& problem, std::size_t i) {
  return !problem.fixed.empty() && problem.fixed[i] != 0;
}

}  // namespace

/// An old order serves any graph on the old vertices and more; whether it serves it well is seen
/// from the work.
bool PoseGraphPlan::Impl::can_extend(const PoseGraphProblem& problem) const {
  return num_poses_ > 0 && model_ == model_of(problem) &&
         num_poses_ <= static_cast<int>(problem.poses.size());
}

bool PoseGraphPlan::Impl::same_structure(const PoseGraphProblem& problem) const {
  if (num_poses_ != static_cast<int>(problem.poses.size()) || model_ != model_of(problem) ||
      ends_.size() != 2 * problem.edges.size())
    return false;
  for (int i = 0; i < num_poses_; ++i)
    if (fixed_at(problem, i) != (fixed_[i] != 0)) return false;
  for (std::size_t k = 0; k < ends_.size() / 2; ++k) {
    const PoseGraphEdge& e = problem.edges[k];
    if (ends_[2 * k] != e.from || ends_[2 * k + 1] != e.to) return false;
    const bool zero = is_zero_information(problem, problem.information[e.information]);
    if (zero != (zero_edge_[k] != 0)) return false;
  }
  return true;
}

void PoseGraphPlan::Impl::remember_structure(const PoseGraphProblem& problem) {
  kind_ = problem.kind;
  model_ = model_of(problem);
  block_size_ = tangent_size(problem.kind, problem.fixed_scale);
  num_poses_ = static_cast<int>(problem.poses.size());
  fixed_.resize(num_poses_);
  for (int i = 0; i < num_poses_; ++i) fixed_[i] = fixed_at(problem, i);
  ends_.resize(2 * problem.edges.size());
  zero_edge_.resize(problem.edges.size());
  std::vector<std::uint8_t> zero(problem.information.size());
  for (std::size_t k = 0; k < zero.size(); ++k)
    zero[k] = is_zero_information(problem, problem.information[k]);
  for (std::size_t k = 0; k < problem.edges.size(); ++k) {
    ends_[2 * k] = problem.edges[k].from;
    ends_[2 * k + 1] = problem.edges[k].to;
    zero_edge_[k] = zero[problem.edges[k].information];
  }
}

/// The new vertices first, the newest of all leading, then the old order. A map grows at an end,
/// where elimination best begins; were the new vertices last, every front on the way inwards would
/// carry them along.
std::vector<int> PoseGraphPlan::Impl::extended_order(const std::vector<int>& old_free_pose,
                                                     const std::vector<int>& old_order) const {
  const int n = static_cast<int>(free_pose_.size());
  std::vector<std::uint8_t> is_new(n, 1);
  for (int pose : old_free_pose)
    if (free_index_[pose] >= 0) is_new[free_index_[pose]] = 0;
  std::vector<int> order;
  order.reserve(n);
  for (int v = n - 1; v >= 0; --v)
    if (is_new[v]) order.push_back(v);
  for (int v : old_order) {
    const int now = free_index_[old_free_pose[v]];
    if (now >= 0) order.push_back(now);
  }
  return order;
}

void PoseGraphPlan::Impl::prepare(const PoseGraphProblem& problem, PoseGraphResult& result) {
  result.plan_reused = same_structure(problem);
  if (!result.plan_reused) {
    Stopwatch watch;
    const bool extend = can_extend(problem);
    std::vector<int> old_free_pose, old_order;
    if (extend) {
      old_free_pose = free_pose_;
      old_order = symbolic_.order;
    }
    remember_structure(problem);
    find_held_vertices(problem, held_);
    free_index_.assign(num_poses_, -1);
    free_pose_.clear();
    for (int i = 0; i < num_poses_; ++i) {
      if (held_.held[i]) continue;
      free_index_[i] = static_cast<int>(free_pose_.size());
      free_pose_.push_back(i);
    }
    std::vector<int> free_ends;
    free_ends.reserve(ends_.size());
    for (std::size_t k = 0; k < ends_.size(); k += 2) {
      const int a = free_index_[ends_[k]], b = free_index_[ends_[k + 1]];
      if (a < 0 || b < 0) continue;
      free_ends.push_back(a);
      free_ends.push_back(b);
    }
    const int n = static_cast<int>(free_pose_.size());
    block::build_graph(n, free_ends, graph_);
    result.times.symbolic_ms += watch.elapsed_ms();
    const auto analyse = [&](std::vector<int> order) {
      Stopwatch symbolic_watch;
      block::build_symbolic_plan(graph_, std::move(order), block_size_, passes_, symbolic_);
      result.times.symbolic_ms += symbolic_watch.elapsed_ms();
    };
    bool fresh = !extend;
    if (extend) {
      analyse(extended_order(old_free_pose, old_order));
      // Extending again and again wears the order out.
      fresh = symbolic_.work > 1.5 * work_per_vertex_at_ordering_ * n;
      result.plan_extended = !fresh;
    }
    if (fresh) {
      watch = Stopwatch();
      std::vector<int> order = block::minimum_degree_order(graph_);
      result.times.ordering_ms += watch.elapsed_ms();
      analyse(std::move(order));
      work_per_vertex_at_ordering_ = symbolic_.work / std::max(1, n);
    }
    watch = Stopwatch();
    assign_slots(problem);
    build_views();
    result.times.symbolic_ms += watch.elapsed_ms();
  }
  resize_scratch();  // there may be more threads than before
  result.components = held_.components;
  result.anchored = held_.anchored;
}

/// Orders the edges as the tasks consume them: an edge belongs to the front that eliminates its
/// first end. Tasks start on whole batches. Edges between held vertices come at the end; they only
/// count for the cost.
void PoseGraphPlan::Impl::assign_slots(const PoseGraphProblem& problem) {
  const std::size_t num_edges = problem.edges.size(), num_fronts = symbolic_.fronts.size();
  const auto elimination_index = [&](int pose) {
    return free_index_[pose] < 0 ? -1 : symbolic_.position[free_index_[pose]];
  };
  std::vector<int> front_of_edge(num_edges);
  std::vector<std::size_t> count(num_fronts + 1, 0);
  passes_.for_chunks((num_edges + kChunk - 1) / kChunk, [&](std::size_t chunk) {
    const std::size_t end = std::min(num_edges, (chunk + 1) * kChunk);
    for (std::size_t k = chunk * kChunk; k < end; ++k) {
      const int a = elimination_index(ends_[2 * k]), b = elimination_index(ends_[2 * k + 1]);
      const int first = a < 0 ? b : b < 0 ? a : std::min(a, b);
      front_of_edge[k] = first < 0 ? static_cast<int>(num_fronts) : symbolic_.front_of[first];
    }
  });
  for (int front : front_of_edge) ++count[front];
  front_edges_begin_.resize(num_fronts + 1);
  front_edges_end_.resize(num_fronts + 1);
  std::size_t slot = 0;
  const auto place = [&](std::size_t front) {
    front_edges_begin_[front] = front_edges_end_[front] = slot;
    slot += count[front];
  };
  const auto round_up = [](std::size_t s) {
    return (s + block::kLanes - 1) / block::kLanes * block::kLanes;
  };
  for (const block::Task& t : symbolic_.tasks) {
    for (std::size_t i = t.begin; i < t.end; ++i) place(symbolic_.task_fronts[i]);
    slot = round_up(slot);
  }
  place(num_fronts);
  slot = round_up(slot);
  num_batches_ = slot / block::kLanes;
  edge_of_slot_.assign(slot, -1);
  from_.assign(slot, 0);
  to_.assign(slot, 0);
  edge_position_.assign(2 * slot, -1);
  for (std::size_t k = 0; k < num_edges; ++k)
    edge_of_slot_[front_edges_end_[front_of_edge[k]]++] = static_cast<std::int64_t>(k);
  passes_.for_chunks((slot + kChunk - 1) / kChunk, [&](std::size_t chunk) {
    const std::size_t end = std::min(slot, (chunk + 1) * kChunk);
    for (std::size_t s = chunk * kChunk; s < end; ++s) {
      if (edge_of_slot_[s] < 0) continue;
      const std::size_t k = static_cast<std::size_t>(edge_of_slot_[s]);
      from_[s] = ends_[2 * k];
      to_[s] = ends_[2 * k + 1];
      if (front_of_edge[k] == static_cast<int>(num_fronts)) continue;
      const block::Front& f = symbolic_.fronts[front_of_edge[k]];
      for (int e = 0; e < 2; ++e)
        edge_position_[2 * s + e] = position_in(f, elimination_index(ends_[2 * k + e]));
    }
  });
}

/// Block of an eliminated vertex in a front; -1 for vertices that are held.
int PoseGraphPlan::Impl::position_in(const block::Front& f, int index) const {
  if (index < 0) return -1;
  if (index < f.first + f.pivots) return index - f.first;
  const auto rows = symbolic_.rows.begin() + static_cast<std::ptrdiff_t>(f.rows);
  return f.pivots + static_cast<int>(std::lower_bound(rows, rows + f.below, index) - rows);
}

void PoseGraphPlan::Impl::build_views() {
  panel_.resize(symbolic_.panel_size);
  schur_.resize(symbolic_.schur_size);
  rhs_.resize(symbolic_.rhs_size);
  step_.resize(free_pose_.size() * block_size_);
  const std::size_t n = symbolic_.fronts.size();
  fronts_.resize(n);
  children_.resize(symbolic_.children.size());
  front_norm_.resize(n);
  passes_.for_chunks((n + kChunk - 1) / kChunk, [&](std::size_t chunk) {
    const std::size_t end = std::min(n, (chunk + 1) * kChunk);
    for (std::size_t k = chunk * kChunk; k < end; ++k) build_view(k);
  });
}

/// Every thread keeps the update matrices of the task it works on to itself: a megabyte or two that
/// stay in the caches, where one stretch of memory per task would come from memory every time.
void PoseGraphPlan::Impl::resize_scratch() {
  const std::size_t front = static_cast<std::size_t>(symbolic_.max_front_blocks) * block_size_ + 8;
  scratch_.resize(std::max(scratch_.size(), static_cast<std::size_t>(passes_.threads())));
  for (block::Buffer& scratch : scratch_) scratch.resize(std::max(symbolic_.scratch_size, front));
}

void PoseGraphPlan::Impl::build_view(std::size_t k) {
  const block::Front& f = symbolic_.fronts[k];
  block::FrontView& v = fronts_[k];
  v.panel = panel_.data() + f.panel_offset;
  v.panel_stride = f.panel_stride;
  v.schur = f.schur_shared ? schur_.data() + f.schur_offset : nullptr;
  v.schur_offset = f.schur_offset;
  v.schur_stride = f.schur_stride;
  v.schur_first_row = f.schur_first_row;
  v.pivots = f.pivots;
  v.below = f.below;
  v.first_vertex = f.first;
  v.edges_begin = front_edges_begin_[k];
  v.edges_end = front_edges_end_[k];
  v.edge_position = edge_position_.data();
  v.children = children_.data() + f.children;
  v.num_children = f.num_children;
  v.rhs = rhs_.data() + f.rhs_offset;
  for (int c = 0; c < f.num_children; ++c) {
    const block::Front& child = symbolic_.fronts[symbolic_.children[f.children + c]];
    block::ChildView& view = children_[f.children + c];
    view.schur = child.schur_shared ? schur_.data() : nullptr;
    view.schur_offset =
        child.schur_offset +
        static_cast<std::size_t>(child.pivots * block_size_ - child.schur_first_row);
    view.stride = child.schur_stride;
    view.blocks = child.below;
    view.position = symbolic_.position_in_parent.data() + child.rows;
    view.runs = symbolic_.runs.data() + child.runs;
    view.num_runs = child.num_runs;
    view.rhs = rhs_.data() + child.rhs_offset;
  }
}

}  // namespace fastloop::optimization
