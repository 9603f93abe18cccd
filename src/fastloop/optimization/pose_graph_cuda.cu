#include <algorithm>
#include <cstring>

#include "fastloop/compute/cuda_support.cuh"
#include "fastloop/optimization/pose_graph_cuda_kernels.cuh"
#include "fastloop/optimization/pose_graph_steps.hpp"

namespace fastloop::optimization::device {
namespace {

/// Shared memory of a block of the substitutions: vectors and, where it fits, the front's factor.

/// Shared memory of a block of the substitutions: vectors and, where it fits, the front's factor.
constexpr std::size_t kSolveDoubles = 8192, kSolveDoublesOfFew = 13312;

/// Arrays laid out one after the other, so that one copy takes them all.
class Packer {
 public:
  template <class T>
  std::size_t add(const std::vector<T>& values) {
    parts_.push_back({values.data(), values.size() * sizeof(T), size_});
    const std::size_t at = size_;
    size_ += (values.size() * sizeof(T) + 255) / 256 * 256;
    return at;
  }
  std::size_t size() const { return size_; }
  void write(char* to) const {
    for (const Part& p : parts_)
      if (p.bytes > 0) std::memcpy(to + p.at, p.data, p.bytes);
  }

 private:
  struct Part {
    const void* data;
    std::size_t bytes, at;
  };
  std::vector<Part> parts_;
  std::size_t size_ = 0;
};

class CudaExecutor : public StepExecutor {
 public:
  explicit CudaExecutor(std::shared_ptr<CudaSession> session)
      : session_(std::move(session)), cuda_(session_->impl()) {
    result_.reserve(cuda_, 1);
    *result_.data() = StepResult{};
  }
  ~CudaExecutor() override {
    if (session_->usable()) cudaStreamSynchronize(cuda_.stream);
  }

  std::unique_lock<std::mutex> lock() override {
    std::unique_lock<std::mutex> held(session_->mutex());
    cuda_.use();
    return held;
  }
  void report_failure(const std::string& what) override {
    session_->report_failure("pose graph", what);
  }
  std::pair<std::uint64_t, std::uint64_t> launches_and_waits() const override {
    return {cuda_.launches, cuda_.synchronizations};
  }
  std::size_t max_shared_doubles() const override {
    return static_cast<std::size_t>(cuda_.shared_bytes_per_block - 1024) / sizeof(double);
  }

  void set_schedule(const Schedule& s, block::EdgeModel model) override;
  Numbers stage(std::size_t poses, std::size_t edges, std::size_t matrices) override;
  double start(int robust_kernel, double robust_width) override;
  double restart(int robust_kernel) override;
  StepResult factor_step(double lambda) override;
  StepResult old_factor_step() override;
  void accept() override {
    now_ = 1 - now_;
    point_at(now_);
  }
  void squared(std::span<double> out) override;
  const double* poses() override;

 private:
  std::size_t pose_doubles() const { return 8 * static_cast<std::size_t>(view_.num_poses); }
  void point_at(int now) {
    view_.poses = poses_[now];
    view_.next_poses = poses_[1 - now];
    view_.normal = normal_[now];
    view_.next_normal = normal_[1 - now];
  }
  void upload(const Schedule& s);
  void reserve_work(const Schedule& s, int stride);
  template <class Kernel>
  int grid_of(Kernel kernel, int threads, std::size_t bytes, std::size_t tasks);
  template <EdgeModel M>
  void configure(const Schedule& s);
  template <EdgeModel M>
  void launch_linearize(int which);
  void launch_step_end();
  StepResult wait_for_result();

  std::shared_ptr<CudaSession> session_;
  CudaSession::Impl& cuda_;
  EdgeModel model_ = EdgeModel::kSe3;
  View view_{};
  int now_ = 0, sequence_ = 0;
  int factor_grid_ = 1, forward_grid_ = 1, backward_grid_ = 1;
  std::size_t factor_bytes_ = 0, solve_bytes_ = 0;
  DeviceBuffer<char> structure_;
  DeviceBuffer<double> numbers_, work_, panel_, schur_, normals_;
  DeviceBuffer<std::int32_t> flags_;
  PinnedBuffer<char> structure_staging_;
  PinnedBuffer<double> numbers_staging_, pose_staging_;
  PinnedBuffer<StepResult> result_;
  double* poses_[2] = {};
  double* normal_[2] = {};
  std::size_t numbers_doubles_ = 0, measurement_at_ = 0, matrices_at_ = 0, information_at_ = 0;
};

void CudaExecutor::upload(const Schedule& s) {
  Packer packer;
  const std::size_t fronts = packer.add(s.fronts), tasks = packer.add(s.tasks),
                    ascent = packer.add(s.ascent), descent = packer.add(s.descent),
                    children = packer.add(s.children), rows = packer.add(s.rows),
                    map = packer.add(s.map), pairs = packer.add(s.pairs),
                    begin = packer.add(s.edges_begin), edges = packer.add(s.edges),
                    pose_of = packer.add(s.pose_of), from = packer.add(s.from),
                    to = packer.add(s.to), edge_of_slot = packer.add(s.edge_of_slot);
  structure_.reserve(cuda_, packer.size());
  structure_staging_.reserve(cuda_, packer.size());
  packer.write(structure_staging_.data());
  cuda_.to_device(structure_.data(), structure_staging_.data(), packer.size());
  const char* base = structure_.data();
  const auto ints = [&](std::size_t at) {
    return reinterpret_cast<const std::int32_t*>(base + at);
  };
  view_.fronts = reinterpret_cast<const Front*>(base + fronts);
  view_.tasks = reinterpret_cast<const Task*>(base + tasks);
  view_.pairs = reinterpret_cast<const Pair*>(base + pairs);
  view_.ascent = ints(ascent);
  view_.descent = ints(descent);
  view_.children = ints(children);
  view_.rows = ints(rows);
  view_.map = ints(map);
  view_.edges_begin = ints(begin);
  view_.edges = ints(edges);
  view_.pose_of = ints(pose_of);
  view_.from = ints(from);
  view_.to = ints(to);
  view_.edge_of_slot = ints(edge_of_slot);
}

void CudaExecutor::reserve_work(const Schedule& s, int stride) {
  const auto aligned = [](std::size_t n) { return (n + 31) / 32 * 32; };
  const std::size_t slots = static_cast<std::size_t>(s.num_slots), fronts = s.fronts.size();
  const std::size_t rhs = aligned(s.rhs_blocks * s.block_size);
  const std::size_t step = aligned(static_cast<std::size_t>(s.num_vertices) * s.block_size);
  const std::size_t chunks = aligned((slots + kChunk - 1) / kChunk);
  work_.reserve(cuda_, rhs + step + aligned(fronts) + chunks + aligned(slots));
  double* p = work_.data();
  const auto take = [&](std::size_t n) {
    double* at = p;
    p += n;
    return at;
  };
  view_.rhs = take(rhs);
  view_.step = take(step);
  view_.front_norm = take(aligned(fronts));
  view_.chunk_cost = take(chunks);
  view_.squared = take(aligned(slots));
  panel_.reserve(cuda_, s.panel_doubles);
  schur_.reserve(cuda_, s.schur_doubles);
  view_.panel = panel_.data();
  view_.schur = schur_.data();
  const std::size_t normal = aligned(slots * static_cast<std::size_t>(stride));
  normals_.reserve(cuda_, 2 * normal);
  normal_[0] = normals_.data();
  normal_[1] = normals_.data() + normal;
  const std::size_t flags = 3 * fronts + s.tile_flags + 5;
  flags_.reserve(cuda_, flags);
  cuda_.clear(flags_.data(), flags * sizeof(std::int32_t));
  cuda_.clear(view_.front_norm, fronts * sizeof(double));
  view_.front_done = flags_.data();
  view_.forward_done = view_.front_done + fronts;
  view_.descent_done = view_.forward_done + fronts;
  view_.tile_done = view_.descent_done + fronts;
  view_.tickets = view_.tile_done + s.tile_flags;
  view_.failed = view_.tickets + 4;
}

template <class Kernel>
int CudaExecutor::grid_of(Kernel kernel, int threads, std::size_t bytes, std::size_t tasks) {
  cuda_.check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize,
                                   static_cast<int>(bytes)),
              "cudaFuncSetAttribute");
  int blocks = 0;
  cuda_.check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernel, threads, bytes),
              "cudaOccupancyMaxActiveBlocksPerMultiprocessor");
  return static_cast<int>(std::clamp<std::size_t>(
      tasks, 1, static_cast<std::size_t>(std::max(1, blocks)) * cuda_.multiprocessors));
}

template <EdgeModel M>
void CudaExecutor::configure(const Schedule& s) {
  factor_bytes_ = s.factor_shared_doubles * sizeof(double);
  const std::size_t vectors = s.solve_rows + 2;
  // Room for a whole panel pays where all fronts run at once, more blocks at a time where not.
  const bool few = s.fronts.size() <= 2 * static_cast<std::size_t>(cuda_.multiprocessors);
  const std::size_t room = few ? kSolveDoublesOfFew : kSolveDoubles;
  solve_bytes_ =
      std::max(vectors, std::min(vectors + s.solve_panel_doubles, room)) * sizeof(double);
  if (solve_bytes_ > static_cast<std::size_t>(cuda_.shared_bytes_per_block))
    throw CudaError(cudaErrorInvalidConfiguration, "a front is too large for this device");
  factor_grid_ = grid_of(factor_kernel<M>, kFactorThreads, factor_bytes_, s.tasks.size());
  forward_grid_ = grid_of(forward_kernel<M>, kSolveThreads, solve_bytes_, s.fronts.size());
  backward_grid_ = grid_of(backward_kernel<M>, kSolveThreads, solve_bytes_, s.fronts.size());
}

void CudaExecutor::set_schedule(const Schedule& s, block::EdgeModel model) {
  model_ = model;
  view_ = View{};
  view_.num_fronts = static_cast<int>(s.fronts.size());
  view_.num_tasks = static_cast<int>(s.tasks.size());
  view_.num_vertices = s.num_vertices;
  view_.num_slots = s.num_slots;
  view_.num_poses = s.num_poses;
  cuda_.synchronize();  // staging memory may still be read
  upload(s);
  with_model(model, [&]<EdgeModel M>() {
    reserve_work(s, Model<M>::kStride);
    configure<M>(s);
  });
}

Numbers CudaExecutor::stage(std::size_t poses, std::size_t edges, std::size_t matrices) {
  measurement_at_ = (8 * poses + 31) / 32 * 32;
  matrices_at_ = measurement_at_ + 8 * edges;
  information_at_ = matrices_at_ + 28 * matrices;
  numbers_doubles_ = information_at_ + (edges + 1) / 2;
  numbers_staging_.reserve(cuda_, numbers_doubles_);
  numbers_.reserve(cuda_, numbers_doubles_ + measurement_at_ + 2);
  double* from = numbers_staging_.data();
  return {from, from + measurement_at_, reinterpret_cast<std::int32_t*>(from + information_at_),
          from + matrices_at_};
}

template <EdgeModel M>
void CudaExecutor::launch_linearize(int which) {
  const int chunks = std::max(1, (view_.num_slots + kChunk - 1) / kChunk);
  linearize_kernel<M><<<chunks, kChunk, 0, cuda_.stream>>>(view_, poses_[which], normal_[which],
                                                           result_.data(), ++sequence_);
  cuda_.launched("linearize_kernel");
}

/// The host looks at a number in its own memory, which is several times faster than waiting for the
/// stream; the driver is asked now and then whether the device is still well.
StepResult CudaExecutor::wait_for_result() {
  ++cuda_.synchronizations;
  const volatile StepResult* result = result_.data();
  for (std::uint64_t spin = 1; result->sequence != sequence_; ++spin) {
    if (spin % 4096 != 0) continue;
    const cudaError_t state = cudaStreamQuery(cuda_.stream);
    if (state == cudaErrorNotReady) continue;
    cuda_.check(state, "pose graph step");
    if (result->sequence != sequence_) cuda_.synchronize();
  }
  std::atomic_thread_fence(std::memory_order_acquire);
  return *result_.data();
}

double CudaExecutor::start(int robust_kernel, double robust_width) {
  view_.robust_width = robust_width;
  double* to = numbers_.data();
  poses_[0] = to;
  poses_[1] = to + (numbers_doubles_ + 1) / 2 * 2;
  view_.measurement = to + measurement_at_;
  view_.matrices = to + matrices_at_;
  view_.information = reinterpret_cast<const std::int32_t*>(to + information_at_);
  cuda_.to_device(to, numbers_staging_.data(), numbers_doubles_ * sizeof(double));
  FASTLOOP_CUDA_CHECK(cuda_, cudaMemcpyAsync(poses_[1], poses_[0], pose_doubles() * sizeof(double),
                                             cudaMemcpyDeviceToDevice, cuda_.stream));
  now_ = 0;
  point_at(now_);
  view_.robust_kernel = robust_kernel;
  with_model(model_, [&]<EdgeModel M>() { launch_linearize<M>(now_); });
  return wait_for_result().cost;
}

double CudaExecutor::restart(int robust_kernel) {
  view_.robust_kernel = robust_kernel;
  cuda_.to_device(numbers_.data() + information_at_, numbers_staging_.data() + information_at_,
                  (numbers_doubles_ - information_at_) * sizeof(double));
  with_model(model_, [&]<EdgeModel M>() { launch_linearize<M>(now_); });
  return wait_for_result().cost;
}

void CudaExecutor::launch_step_end() {
  ++view_.descent_epoch;
  with_model(model_, [&]<EdgeModel M>() {
    backward_kernel<M><<<backward_grid_, kSolveThreads, solve_bytes_, cuda_.stream>>>(
        view_, static_cast<int>(solve_bytes_ / sizeof(double)));
    cuda_.launched("backward_kernel");
    launch_linearize<M>(1 - now_);
  });
}

StepResult CudaExecutor::factor_step(double lambda) {
  view_.lambda = lambda;
  ++view_.factor_epoch;
  with_model(model_, [&]<EdgeModel M>() {
    factor_kernel<M><<<factor_grid_, kFactorThreads, factor_bytes_, cuda_.stream>>>(view_);
  });
  cuda_.launched("factor_kernel");
  launch_step_end();
  return wait_for_result();
}

StepResult CudaExecutor::old_factor_step() {
  ++view_.forward_epoch;
  with_model(model_, [&]<EdgeModel M>() {
    forward_kernel<M><<<forward_grid_, kSolveThreads, solve_bytes_, cuda_.stream>>>(
        view_, static_cast<int>(solve_bytes_ / sizeof(double)));
  });
  cuda_.launched("forward_kernel");
  launch_step_end();
  return wait_for_result();
}

void CudaExecutor::squared(std::span<double> out) {
  with_model(model_, [&]<EdgeModel M>() { launch_linearize<M>(now_); });
  pose_staging_.reserve(cuda_, out.size());
  cuda_.to_host(pose_staging_.data(), view_.squared, out.size_bytes());
  cuda_.synchronize();
  std::copy_n(pose_staging_.data(), out.size(), out.begin());
}

const double* CudaExecutor::poses() {
  pose_staging_.reserve(cuda_, pose_doubles());
  cuda_.to_host(pose_staging_.data(), poses_[now_], pose_doubles() * sizeof(double));
  cuda_.synchronize();
  return pose_staging_.data();
}

}  // namespace

std::unique_ptr<StepExecutor> make_cuda_executor() {
  std::shared_ptr<CudaSession> session = CudaSession::process_wide();
  if (!session || !session->usable()) return nullptr;
  return std::make_unique<CudaExecutor>(std::move(session));
}

}  // namespace fastloop::optimization::device
