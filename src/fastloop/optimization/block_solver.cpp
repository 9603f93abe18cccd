#include "fastloop/optimization/block_solver.hpp"

#include <algorithm>
#include <cmath>

#include "fastloop/core/time.hpp"
#include "fastloop/optimization/pose_graph_iteration.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {

std::vector<const block::KernelSet*> block::usable_kernels() {
  std::vector<const KernelSet*> sets{&portable_kernels()};
#if defined(__x86_64__)
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    sets.push_back(&avx2_kernels());
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl"))
    sets.push_back(&avx512_kernels());
#endif
  return sets;
}

PoseGraphPlan::Impl::Impl() : kernel_set_(block::usable_kernels().back()) {}
PoseGraphPlan::Impl::~Impl() = default;

namespace {

constexpr std::size_t kChunkVertices = 512;
// Share of the cost that the quadratic model may have failed to foresee if refining is to be tried,
// and the same for factors beyond the caches, where two substitutions cost nearly as much as a
// factorisation.
constexpr double kMaxExcess = 0.3, kMaxExcessLarge = 0.05;
constexpr std::size_t kLargeFactor = std::size_t{1} << 23;  // doubles

}  // namespace

bool PoseGraphPlan::Impl::factor(double lambda) {
  context_.poses = poses_.data();
  context_.lambda = lambda;
  context_.damping = nullptr;
  if (lambda > 0) {
    build_damping();
    context_.damping = damping_.data();
  }
  std::vector<std::uint8_t>& ok = task_ok_;
  ok.assign(symbolic_.tasks.size(), 0);
  passes_.bottom_up(symbolic_, [&](std::size_t task) {
    const block::Task& t = symbolic_.tasks[task];
    block::BatchCursor cursor;
    double* scratch = thread_scratch();
    for (std::size_t i = t.begin; i < t.end; ++i)
      if (!kernels_.factor(context_, fronts_[symbolic_.task_fronts[i]], cursor, scratch)) return;
    ok[task] = 1;
  });
  return std::find(ok.begin(), ok.end(), 0) == ok.end();
}

double PoseGraphPlan::Impl::measure_linearization() {
  const Stopwatch watch;
  constexpr std::size_t kChunk = 64;
  passes_.for_chunks((num_batches_ + kChunk - 1) / kChunk, [&](std::size_t chunk) {
    block::BatchCursor cursor;
    const std::size_t end = std::min(num_batches_, (chunk + 1) * kChunk);
    for (std::size_t b = chunk * kChunk; b < end; ++b)
      kernels_.linearize(context_, cursor, static_cast<std::ptrdiff_t>(b));
  });
  return watch.elapsed_ms();
}

void PoseGraphPlan::Impl::forward() {
  context_.poses = poses_.data();
  passes_.bottom_up(symbolic_, [&](std::size_t task) {
    const block::Task& t = symbolic_.tasks[task];
    block::BatchCursor cursor;
    double* scratch = thread_scratch();
    for (std::size_t i = t.begin; i < t.end; ++i)
      kernels_.forward(context_, fronts_[symbolic_.task_fronts[i]], cursor, scratch);
  });
}

double PoseGraphPlan::Impl::backward() {
  const int d = block_size_;
  passes_.top_down(symbolic_, [&](std::size_t task) {
    const block::Task& t = symbolic_.tasks[task];
    double* x = thread_scratch();
    for (std::size_t i = t.end; i-- > t.begin;) {
      const int k = symbolic_.task_fronts[i];
      const block::Front& f = symbolic_.fronts[k];
      double* below = x + f.pivots * d;
      for (int r = 0; r < f.below; ++r) {
        const double* from =
            step_.data() + static_cast<std::size_t>(symbolic_.rows[f.rows + r]) * d;
        for (int c = 0; c < d; ++c) *below++ = from[c];
      }
      front_norm_[k] = kernels_.backward(fronts_[k], x);
      std::copy_n(x, f.pivots * d, step_.data() + static_cast<std::size_t>(f.first) * d);
    }
  });
  double total = 0;
  for (double s : front_norm_) total += s;
  return total;
}

namespace {

/// move_vertex of the 4-DoF kind without what that kind does not need.
void move_yaw(const double* p, const double* d, double* q) {
  const double half = 0.5 * d[0], s = std::sin(half), c = std::cos(half);
  q[0] = c * p[0] - s * p[1];
  q[1] = c * p[1] + s * p[0];
  q[2] = c * p[2] + s * p[3];
  q[3] = c * p[3] - s * p[2];
  const double norm = 1 / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int i = 0; i < 4; ++i) q[i] *= norm;
  q[4] = p[4] - d[0] * p[5] + d[1];
  q[5] = p[5] + d[0] * p[4] + d[2];
  q[6] = p[6] + d[3];
  q[7] = p[7];
}

Sim3 pose_at(const double* p) {
  Sim3 x;
  x.rotation = Eigen::Quaterniond(p[3], p[0], p[1], p[2]);
  x.translation = Vector3d(p[4], p[5], p[6]);
  x.scale = p[7];
  return x;
}

void move_pose(PoseGraphKind kind, const double* p, const Vector7d& d, double* q) {
  const Sim3 x = move_vertex(kind, pose_at(p), d);
  Eigen::Map<Eigen::Vector4d>(q, 4) = x.rotation.coeffs();
  Eigen::Map<Vector3d>(q + 4, 3) = x.translation;
  q[7] = x.scale;
}

}  // namespace

void PoseGraphPlan::Impl::move_poses() {
  const std::size_t n = free_pose_.size();
  passes_.for_chunks((n + kChunkVertices - 1) / kChunkVertices, [&](std::size_t chunk) {
    const std::size_t end = std::min(n, (chunk + 1) * kChunkVertices);
    for (std::size_t k = chunk * kChunkVertices; k < end; ++k) {
      const std::size_t pose = static_cast<std::size_t>(free_pose_[symbolic_.order[k]]);
      const double* p = poses_.data() + 8 * pose;
      double* q = candidate_.data() + 8 * pose;
      const double* step = step_.data() + k * block_size_;
      if (kind_ == PoseGraphKind::kYaw) {
        move_yaw(p, step, q);
        continue;
      }
      Vector7d d = Vector7d::Zero();
      for (int c = 0; c < block_size_; ++c) d[c] = step[c];
      move_pose(kind_, p, d, q);
    }
  });
}

/// Metric of the damping: squared length of a step seen in the vertex's own frame, where it does
/// not depend on where the world's origin is.
void PoseGraphPlan::Impl::build_damping() {
  damping_.resize(free_pose_.size() * 28);
  const int d = block_size_;
  for (std::size_t k = 0; k < free_pose_.size(); ++k) {
    const double* p = poses_.data() + 8 * static_cast<std::size_t>(free_pose_[symbolic_.order[k]]);
    const Vector3d t(p[4], p[5], p[6]);
    Matrix7d j =
        Matrix7d::Identity();  // rows: rotation, translation, log scale in the vertex frame
    if (kind_ == PoseGraphKind::kYaw) {
      j.setZero();
      j(2, 0) = 1;
      j.block<3, 1>(3, 0) = Vector3d::UnitZ().cross(t);
      j.block<3, 3>(3, 1).setIdentity();
    } else {
      j.block<3, 3>(3, 0) = -so3::hat(t);
      j.block<3, 1>(3, 6) = t;
    }
    j.middleRows<3>(3) /= p[7];
    const Matrix7d metric = j.transpose() * j;
    for (int r = 0; r < d; ++r)
      for (int c = 0; c <= r; ++c) damping_[k * 28 + r * (r + 1) / 2 + c] = metric(r, c);
  }
}

/// What the iteration asks for.
class PoseGraphPlan::Impl::Steps {
 public:
  Steps(Impl& impl, bool split_times, PoseGraphResult& result)
      : impl_(impl), split_times_(split_times), times_(result.times) {}

  bool has_unknowns() const { return !impl_.free_pose_.empty(); }
  double initial_cost() { return impl_.evaluate_cost(impl_.poses_.data(), nullptr); }
  bool factor(double lambda, double& expected) {
    Stopwatch watch;
    const bool positive_definite = impl_.factor(lambda);
    const double factor_ms = watch.elapsed_ms();
    const double linearize_ms =
        split_times_ ? std::min(factor_ms, impl_.measure_linearization()) : 0;
    times_.linearize_ms += linearize_ms;
    times_.factor_ms += factor_ms - linearize_ms;
    if (!positive_definite) return false;
    watch.restart();
    expected = 0.5 * impl_.backward();
    times_.solve_ms += watch.elapsed_ms();
    return true;
  }
  double refine() {
    const Stopwatch watch;
    impl_.forward();
    const double expected = 0.5 * impl_.backward();
    times_.solve_ms += watch.elapsed_ms();
    return expected;
  }
  double candidate_cost() {
    const Stopwatch watch;
    impl_.move_poses();
    const double cost = impl_.evaluate_cost(impl_.candidate_.data(), nullptr);
    times_.update_ms += watch.elapsed_ms();
    return cost;
  }
  void accept() { std::swap(impl_.poses_, impl_.candidate_); }

 private:
  Impl& impl_;
  bool split_times_;
  PoseGraphTimes& times_;
};

void PoseGraphPlan::Impl::iterate(const PoseGraphOptions& options, PoseGraphResult& result) {
  IterationRule rule;
  rule.floor = 1e-24 * damping_scale_ * static_cast<double>(edge_of_slot_.size());
  rule.damping_scale = damping_scale_;
  rule.max_excess = symbolic_.panel_size < kLargeFactor ? kMaxExcess : kMaxExcessLarge;
  Steps steps(*this, options.split_times, result);
  PoseGraphIteration<Steps>(steps, rule, options, result).run();
}

void PoseGraphPlan::Impl::solve(PoseGraphProblem& problem, const PoseGraphOptions& options,
                                PoseGraphResult& result) {
  passes_.set_threads(options.threads);
  prepare(problem, result);
  kernels_ = kernel_set_->model[static_cast<int>(model_)];
  load(problem, options);
  iterate(options, result);
  if (std::isfinite(options.rejection_gate) &&
      reject_outliers(problem, options.rejection_gate, result) > 0) {
    context_.robust_kernel = 0;
    iterate(options, result);
  }
  result.initial_cost = result.cost_history.front();
  store_poses(problem);
}

}  // namespace fastloop::optimization
