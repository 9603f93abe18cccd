#include <algorithm>
#include <stdexcept>

#include "fastloop/optimization/pose_graph_device_passes.hpp"
#include "fastloop/optimization/pose_graph_steps.hpp"

namespace fastloop::optimization::device {
namespace {

/// A team of one. The order in which the executor takes the tasks must make every wait true at
/// once: a device that takes them in that order never waits in vain.
struct SerialTeam {
  int rank() const { return 0; }
  int size() const { return 1; }
  int lane() const { return 0; }
  int lanes() const { return 1; }
  int warp() const { return 0; }
  int warps() const { return 1; }
  void sync() const {}
  void sync_warp() const {}
  double sum(double value) const { return value; }
  double load(const double* p) const { return *p; }
  void copy(double* to, const double* from) const { *to = *from; }
  void finish_copies() const {}
  void wait(const std::int32_t* counter, int value) const {
    if (*counter < value) throw std::logic_error("a task was taken before one that it needs");
  }
  void signal(std::int32_t* counter) const { ++*counter; }
  void publish(std::int32_t* flag, int value) const { *flag = value; }
  void solve_lower(const double* t, int stride, int width, double* x) const {
    for (int c = 0; c < width; ++c) {
      x[c] *= t[c * stride + c];
      for (int r = c + 1; r < width; ++r) x[r] -= t[c * stride + r] * x[c];
    }
  }
  void solve_upper(const double* t, int stride, int width, double* x) const {
    for (int c = width - 1; c >= 0; --c) {
      for (int r = c + 1; r < width; ++r) x[c] -= t[c * stride + r] * x[r];
      x[c] *= t[c * stride + c];
    }
  }

  /// Products of tiles of large fronts.
  struct TileSum {
    explicit TileSum(const SerialTeam&) {}
    void add_product(const Square& x, const Square& y, const Square& c) {
      for (int j = 0; j < kTileRows; ++j) {
        double* column = c.column(j);
        for (int k = 0; k < kTileDepth; ++k) {
          const double s = y.column(k)[j];
          const double* from = x.column(k);
          for (int r = 0; r < kTileRows; ++r) column[r] -= s * from[r];
        }
      }
    }
    void subtract_from(const Square&) {}
  };
};

class HostExecutor : public StepExecutor {
 public:
  explicit HostExecutor(std::size_t max_shared) : max_shared_(max_shared) {}

  std::size_t max_shared_doubles() const override { return max_shared_; }

  void set_schedule(const Schedule& s, block::EdgeModel model) override {
    schedule_ = s;
    model_ = model;
    panel_.assign(s.panel_doubles, 0);
    schur_.assign(s.schur_doubles, 0);
    rhs_.assign(s.rhs_blocks * s.block_size, 0);
    step_.assign(static_cast<std::size_t>(s.num_vertices) * s.block_size, 0);
    front_norm_.assign(s.fronts.size(), 0);
    chunk_cost_.assign((s.num_slots + kChunk - 1) / kChunk, 0);
    squared_.assign(s.num_slots, 0);
    front_done_.assign(s.fronts.size(), 0);
    forward_done_ = descent_done_ = front_done_;
    tile_done_.assign(s.tile_flags, 0);
    shared_.resize(std::max({s.factor_shared_doubles, s.solve_rows + s.solve_panel_doubles + 2,
                             std::size_t{kChunk * 35 + 1}}));
    for (auto& normal : normal_) normal.resize(35 * static_cast<std::size_t>(s.num_slots));
    epoch_ = forward_epoch_ = descent_epoch_ = failed_ = 0;
  }

  Numbers stage(std::size_t poses, std::size_t edges, std::size_t matrices) override {
    poses_[0].resize(8 * poses);
    measurement_.resize(8 * edges);
    information_.resize(edges);
    matrices_.resize(28 * matrices);
    return {poses_[0].data(), measurement_.data(), information_.data(), matrices_.data()};
  }

  double start(int robust_kernel, double robust_width) override {
    robust_width_ = robust_width;
    now_ = 0;
    poses_[1] = poses_[0];
    return restart(robust_kernel);
  }

  double restart(int robust_kernel) override {
    robust_kernel_ = robust_kernel;
    return with_model(model_, [&]<EdgeModel M>() { return linearize<M>(view(), now_); });
  }

  StepResult factor_step(double lambda) override {
    lambda_ = lambda;
    ++epoch_;
    return with_model(model_, [&]<EdgeModel M>() {
      const View v = view();
      for (const Task& t : schedule_.tasks) {
        if (v.fronts[t.front].tiled) {
          factor_tile<M>(team_, v, t, shared_.data());
        } else {
          factor_front<M>(team_, v, t.front, shared_.data());
        }
      }
      return finish<M>(v);
    });
  }

  StepResult old_factor_step() override {
    ++forward_epoch_;
    return with_model(model_, [&]<EdgeModel M>() {
      const View v = view();
      for (int front : schedule_.ascent)
        forward_front<M>(team_, v, front, shared_.data(), shared_size());
      return finish<M>(v);
    });
  }

  void accept() override { now_ = 1 - now_; }

  void squared(std::span<double> out) override {
    restart(robust_kernel_);
    std::copy(squared_.begin(), squared_.end(), out.begin());
  }

  const double* poses() override { return poses_[now_].data(); }

 private:
  int shared_size() const { return static_cast<int>(shared_.size()); }

  template <EdgeModel M>
  double linearize(const View& v, int which) {
    for (int c = 0; c < static_cast<int>(chunk_cost_.size()); ++c)
      linearize_chunk<M>(team_, v, c, poses_[which].data(), normal_[which].data(), shared_.data());
    return 0.5 *
           total(team_, chunk_cost_.data(), static_cast<int>(chunk_cost_.size()), shared_.data());
  }

  template <EdgeModel M>
  StepResult finish(View v) {
    v.descent_epoch = ++descent_epoch_;
    for (int front : schedule_.descent)
      backward_front<M>(team_, v, front, shared_.data(), shared_size());
    StepResult result{};
    result.squared_norm =
        total(team_, front_norm_.data(), static_cast<int>(front_norm_.size()), shared_.data());
    result.cost = linearize<M>(v, 1 - now_);
    result.positive_definite = failed_ != epoch_;
    return result;
  }

  View view() {
    const Schedule& s = schedule_;
    View v{};
    v.num_fronts = static_cast<int>(s.fronts.size());
    v.num_tasks = static_cast<int>(s.tasks.size());
    v.num_vertices = s.num_vertices;
    v.num_slots = s.num_slots;
    v.num_poses = s.num_poses;
    v.fronts = s.fronts.data();
    v.tasks = s.tasks.data();
    v.ascent = s.ascent.data();
    v.descent = s.descent.data();
    v.children = s.children.data();
    v.rows = s.rows.data();
    v.map = s.map.data();
    v.pairs = s.pairs.data();
    v.edges_begin = s.edges_begin.data();
    v.edges = s.edges.data();
    v.pose_of = s.pose_of.data();
    v.from = s.from.data();
    v.to = s.to.data();
    v.edge_of_slot = s.edge_of_slot.data();
    v.measurement = measurement_.data();
    v.information = information_.data();
    v.matrices = matrices_.data();
    v.robust_kernel = robust_kernel_;
    v.robust_width = robust_width_;
    v.poses = poses_[now_].data();
    v.next_poses = poses_[1 - now_].data();
    v.normal = normal_[now_].data();
    v.next_normal = normal_[1 - now_].data();
    v.squared = squared_.data();
    v.panel = panel_.data();
    v.schur = schur_.data();
    v.rhs = rhs_.data();
    v.step = step_.data();
    v.front_norm = front_norm_.data();
    v.chunk_cost = chunk_cost_.data();
    v.front_done = front_done_.data();
    v.forward_done = forward_done_.data();
    v.descent_done = descent_done_.data();
    v.tile_done = tile_done_.data();
    v.failed = &failed_;
    v.factor_epoch = epoch_;
    v.forward_epoch = forward_epoch_;
    v.descent_epoch = descent_epoch_;
    v.lambda = lambda_;
    return v;
  }

  SerialTeam team_;
  std::size_t max_shared_;
  Schedule schedule_;
  EdgeModel model_ = EdgeModel::kSe3;
  std::vector<double> poses_[2], normal_[2], measurement_, matrices_, panel_, schur_, rhs_, step_,
      front_norm_, chunk_cost_, squared_, shared_;
  std::vector<std::int32_t> information_, front_done_, forward_done_, descent_done_, tile_done_;
  std::int32_t failed_ = 0;
  int epoch_ = 0, forward_epoch_ = 0, descent_epoch_ = 0, now_ = 0, robust_kernel_ = 0;
  double robust_width_ = 1, lambda_ = 0;
};

}  // namespace

std::unique_ptr<StepExecutor> make_host_executor(std::size_t max_shared_doubles) {
  return std::make_unique<HostExecutor>(max_shared_doubles);
}

}  // namespace fastloop::optimization::device
