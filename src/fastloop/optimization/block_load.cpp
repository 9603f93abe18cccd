#include <algorithm>
#include <array>
#include <cmath>

#include "fastloop/optimization/block_solver.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {
namespace {

constexpr std::size_t kChunkBatches = 64;
constexpr std::size_t kChunkPoses = 512;
using Eigen::Map;

PoseGraphKind kind_of(block::EdgeModel model) {
  if (model == block::EdgeModel::kYaw) return PoseGraphKind::kYaw;
  return model == block::EdgeModel::kSe3 ? PoseGraphKind::kSe3 : PoseGraphKind::kSim3;
}

Sim3 pose_from(const double* p) {
  Sim3 pose;
  pose.rotation = Eigen::Quaterniond(p[3], p[0], p[1], p[2]);
  pose.translation = Vector3d(p[4], p[5], p[6]);
  pose.scale = p[7];
  return pose;
}

void pose_to(const Sim3& pose, double* p) {
  p[0] = pose.rotation.x();
  p[1] = pose.rotation.y();
  p[2] = pose.rotation.z();
  p[3] = pose.rotation.w();
  p[4] = pose.translation.x();
  p[5] = pose.translation.y();
  p[6] = pose.translation.z();
  p[7] = pose.scale;
}

/// What the kernels read for a measurement, see EdgeBatches.
std::array<double, 8> packed_measurement(PoseGraphKind kind, const Sim3& z) {
  std::array<double, 8> packed;
  Sim3 stored = z.inverse();
  if (kind == PoseGraphKind::kYaw) stored.translation = z.translation;
  pose_to(stored, packed.data());
  return packed;
}

/// One lane of a batch: the packed lower triangle or the diagonal.
void put_information(const PoseGraphInformation& w, bool full, int size, double* to) {
  for (int r = 0; r < size; ++r) {
    for (int c = full ? 0 : r; c <= r; ++c, to += block::kLanes) *to = w(r, c);
  }
}

void exact_edge(block::EdgeModel model, const double* from, const double* to,
                const double* measurement, double* residual, double* jacobian) {
  const PoseGraphKind kind = kind_of(model);
  Sim3 z = pose_from(measurement);
  const Vector3d stored_translation = z.translation;
  z = z.inverse();
  if (kind == PoseGraphKind::kYaw) z.translation = stored_translation;
  const EdgeLinearization l = linearize_edge(kind, pose_from(from), pose_from(to), z);
  Map<Vector7d>(residual, 7) = l.residual;
  Map<Matrix7d>(jacobian, 7, 7) = l.jacobian_to;
}

void exact_robust(int kernel, double width, double squared, double* cost, double* weight) {
  const RobustValue v = evaluate_robust_kernel(static_cast<RobustKernel>(kernel), width, squared);
  *cost = v.cost;
  *weight = v.weight;
}

}  // namespace

/// Where the information of every batch lies. A batch stores diagonals only when all its matrices
/// are diagonal, and batches whose edges all have the same matrix share one copy, which halves what
/// the passes over edges read.
void PoseGraphPlan::Impl::choose_information_layout(const PoseGraphProblem& problem, bool share) {
  const int size = residual_size(problem.kind);
  const std::size_t matrices = problem.information.size();
  full_matrix_.resize(matrices);
  for (std::size_t k = 0; k < matrices; ++k)
    full_matrix_[k] = !problem.information[k].topLeftCorner(size, size).isDiagonal(0.0);
  const auto doubles = [&](bool full) {
    return static_cast<std::size_t>((full ? size * (size + 1) / 2 : size) * block::kLanes);
  };
  full_information_.assign(num_batches_, 0);
  own_information_.assign(num_batches_, 1);
  information_offset_.resize(num_batches_);
  share = share && matrices * block::kLanes <= problem.edges.size();
  shared_offset_.assign(share ? matrices : 0, 0);
  std::size_t offset = 0;
  for (std::size_t k = 0; k < shared_offset_.size(); ++k) {
    shared_offset_[k] = offset;
    offset += doubles(full_matrix_[k]);
  }
  for (std::size_t b = 0; b < num_batches_; ++b) {
    int common = -1;
    for (int lane = 0; lane < block::kLanes; ++lane) {
      const std::int64_t edge = edge_of_slot_[b * block::kLanes + lane];
      const int k = edge < 0 ? -1 : problem.edges[static_cast<std::size_t>(edge)].information;
      if (k >= 0 && full_matrix_[k]) full_information_[b] = 1;
      common = lane == 0 || k == common ? k : -1;
    }
    if (share && common >= 0) {
      own_information_[b] = 0;
      information_offset_[b] = shared_offset_[common];
    } else {
      information_offset_[b] = offset;
      offset += doubles(full_information_[b]);
    }
  }
  information_.resize(offset);
  for (std::size_t k = 0; k < shared_offset_.size(); ++k)
    for (int lane = 0; lane < block::kLanes; ++lane)
      put_information(problem.information[k], full_matrix_[k], size,
                      information_.data() + shared_offset_[k] + lane);
}

void PoseGraphPlan::Impl::load_edge(const PoseGraphProblem& problem, std::size_t slot,
                                    bool robust) {
  const std::size_t batch = slot / block::kLanes, lane = slot % block::kLanes;
  const int size = residual_size(problem.kind);
  double* measurement = measurement_.data() + batch * 8 * block::kLanes + lane;
  const PoseGraphEdge* edge =
      edge_of_slot_[slot] < 0 ? nullptr : &problem.edges[edge_of_slot_[slot]];
  const std::array<double, 8> packed =
      packed_measurement(problem.kind, edge ? edge->T_from_to : Sim3());
  for (int f = 0; f < 8; ++f) measurement[f * block::kLanes] = packed[f];
  if (own_information_[batch]) {
    double* information = information_.data() + information_offset_[batch] + lane;
    put_information(edge ? problem.information[edge->information]
                         : PoseGraphInformation(PoseGraphInformation::Zero()),
                    full_information_[batch] != 0, size, information);
  }
  robust_[slot] = edge && (robust || edge->switchable) ? 1.0 : 0.0;
}

void PoseGraphPlan::Impl::load(const PoseGraphProblem& problem, const PoseGraphOptions& options) {
  const std::size_t n = problem.poses.size();
  poses_.resize(8 * n);
  candidate_.resize(8 * n);
  measurement_.resize(num_batches_ * 8 * block::kLanes);
  robust_.resize(num_batches_ * block::kLanes);
  squared_.resize(num_batches_ * block::kLanes);
  chunk_cost_.resize((num_batches_ + kChunkBatches - 1) / kChunkBatches);
  // Rejected edges lose their information, which must then be their own.
  choose_information_layout(problem, !std::isfinite(options.rejection_gate));

  // The world frame is moved to the middle of the graph: derivatives contain positions, and large
  // coordinates (geographic ones, say) would cost digits.
  origin_.setZero();
  for (const Sim3& pose : problem.poses) origin_ += pose.translation;
  if (n > 0) origin_ /= static_cast<double>(n);
  passes_.for_chunks((n + kChunkPoses - 1) / kChunkPoses, [&](std::size_t chunk) {
    const std::size_t begin = chunk * kChunkPoses, end = std::min(n, begin + kChunkPoses);
    for (std::size_t i = begin; i < end; ++i) {
      Sim3 moved = problem.poses[i];
      moved.translation -= origin_;
      pose_to(moved, poses_.data() + 8 * i);
    }
    std::copy(poses_.data() + 8 * begin, poses_.data() + 8 * end, candidate_.data() + 8 * begin);
  });
  passes_.for_chunks(chunk_cost_.size(), [&](std::size_t chunk) {
    const std::size_t end = std::min(num_batches_, (chunk + 1) * kChunkBatches) * block::kLanes;
    for (std::size_t s = chunk * kChunkBatches * block::kLanes; s < end; ++s)
      load_edge(problem, s, options.robust_on_all_edges);
  });

  context_ = block::PassContext();
  context_.poses = poses_.data();
  context_.edges = {from_.data(),
                    to_.data(),
                    measurement_.data(),
                    full_information_.data(),
                    information_offset_.data(),
                    information_.data(),
                    robust_.data()};
  context_.robust_kernel = static_cast<int>(options.robust_kernel);
  context_.robust_width = options.robust_width;
  context_.exact_edge = exact_edge;
  context_.exact_robust = exact_robust;
  damping_scale_ = damping_scale(problem);
}

/// Size of the largest diagonal entries of the normal equations in the frames of the vertices.
double PoseGraphPlan::Impl::damping_scale(const PoseGraphProblem& problem) const {
  const int size = residual_size(problem.kind);
  double largest = 0;
  for (const PoseGraphInformation& w : problem.information)
    largest = std::max(largest, w.diagonal().head(size).maxCoeff());
  const double edges_per_vertex =
      2.0 * static_cast<double>(problem.edges.size()) /
      static_cast<double>(std::max<std::size_t>(1, problem.poses.size()));
  return std::max(largest * edges_per_vertex, 1e-12);
}

void PoseGraphPlan::Impl::store_poses(PoseGraphProblem& problem) {
  const std::size_t n = problem.poses.size();
  passes_.for_chunks((n + kChunkPoses - 1) / kChunkPoses, [&](std::size_t chunk) {
    const std::size_t end = std::min(n, (chunk + 1) * kChunkPoses);
    for (std::size_t i = chunk * kChunkPoses; i < end; ++i) {
      if (free_index_[i] < 0) continue;
      problem.poses[i] = pose_from(poses_.data() + 8 * i);
      problem.poses[i].translation += origin_;
    }
  });
}

int PoseGraphPlan::Impl::reject_outliers(const PoseGraphProblem& problem, double gate,
                                         PoseGraphResult& result) {
  const int size = residual_size(problem.kind);
  evaluate_cost(poses_.data(), squared_.data());
  for (std::size_t s = 0; s < edge_of_slot_.size(); ++s) {
    if (edge_of_slot_[s] < 0 || !problem.edges[edge_of_slot_[s]].switchable || squared_[s] <= gate)
      continue;
    result.rejected.push_back(static_cast<int>(edge_of_slot_[s]));
    const std::size_t batch = s / block::kLanes;
    const int entries = full_information_[batch] ? size * (size + 1) / 2 : size;
    for (int k = 0; k < entries; ++k)
      information_[information_offset_[batch] + k * block::kLanes + s % block::kLanes] = 0;
  }
  std::sort(result.rejected.begin(), result.rejected.end());
  return static_cast<int>(result.rejected.size());
}

double PoseGraphPlan::Impl::evaluate_cost(const double* poses, double* squared) {
  block::PassContext context = context_;
  context.poses = poses;
  passes_.for_chunks(chunk_cost_.size(), [&](std::size_t chunk) {
    const std::size_t begin = chunk * kChunkBatches,
                      end = std::min(num_batches_, begin + kChunkBatches);
    chunk_cost_[chunk] = kernels_.cost(context, begin, end, squared);
  });
  double total = 0;
  for (double c : chunk_cost_) total += c;
  return 0.5 * total;
}

}  // namespace fastloop::optimization
