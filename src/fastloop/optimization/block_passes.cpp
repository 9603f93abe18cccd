#include "fastloop/optimization/block_passes.hpp"

#include <tbb/info.h>
#include <tbb/parallel_for.h>
#include <tbb/spin_mutex.h>
#include <tbb/task_arena.h>
#include <tbb/task_group.h>

#include <algorithm>
#include <functional>
#include <new>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace fastloop::optimization::block {

void Buffer::resize(std::size_t size) {
  if (size <= capacity_) return;
  data_.reset();
  constexpr std::size_t kHugePage = std::size_t{2} << 20;
  std::size_t bytes = size * sizeof(double);
  const std::size_t alignment = bytes >= 2 * kHugePage ? kHugePage : 64;
  bytes = (bytes + alignment - 1) / alignment * alignment;
  void* p = std::aligned_alloc(alignment, bytes);
  if (p == nullptr) throw std::bad_alloc();
#if defined(__linux__)
  // Fresh memory is touched front by front; large pages make that several times cheaper. Only a
  // hint.
  if (alignment == kHugePage) madvise(p, bytes, MADV_HUGEPAGE);
#endif
  data_.reset(static_cast<double*>(p));
  capacity_ = bytes / sizeof(double);
}

struct Passes::Threads {
  explicit Threads(int n) : count(n), arena(n) {}
  int count;
  tbb::task_arena arena;
  tbb::spin_mutex mutex;                      // tasks are short: sleeping would cost more
  std::vector<int> waiting;                   // feeding tasks that have not ended
  std::vector<std::pair<double, int>> ready;  // heap, the longest way to the root on top
  std::vector<int> feeding_begin, feeding;

  void start(const SymbolicPlan& plan) {
    waiting.resize(plan.tasks.size());
    ready.clear();
    for (std::size_t t = 0; t < plan.tasks.size(); ++t) {
      waiting[t] = plan.tasks[t].num_feeding;
      if (waiting[t] == 0) ready.emplace_back(plan.tasks[t].path, static_cast<int>(t));
    }
    std::make_heap(ready.begin(), ready.end());
  }

  /// Notes that `ended` (or -1) has ended and gives the next task, or -1.
  int take(const SymbolicPlan& plan, int ended) {
    const tbb::spin_mutex::scoped_lock lock(mutex);
    const int above = ended < 0 ? -1 : plan.tasks[ended].parent;
    if (above >= 0 && --waiting[above] == 0) {
      ready.emplace_back(plan.tasks[above].path, above);
      std::push_heap(ready.begin(), ready.end());
    }
    if (ready.empty()) return -1;
    std::pop_heap(ready.begin(), ready.end());
    const int task = ready.back().second;
    ready.pop_back();
    return task;
  }

  bool linked = false;

  void link(const SymbolicPlan& plan) {
    if (linked) return;
    linked = true;
    feeding_begin.assign(plan.tasks.size() + 1, 0);
    for (const Task& t : plan.tasks)
      if (t.parent >= 0) ++feeding_begin[t.parent + 1];
    for (std::size_t t = 0; t < plan.tasks.size(); ++t) feeding_begin[t + 1] += feeding_begin[t];
    feeding.resize(feeding_begin.back());
    std::vector<int> cursor(feeding_begin.begin(), feeding_begin.end() - 1);
    for (std::size_t t = 0; t < plan.tasks.size(); ++t)
      if (plan.tasks[t].parent >= 0) feeding[cursor[plan.tasks[t].parent]++] = static_cast<int>(t);
    // Whoever ends a task goes down the longest way and leaves the others to be picked up.
    for (std::size_t t = 0; t < plan.tasks.size(); ++t)
      std::sort(feeding.begin() + feeding_begin[t], feeding.begin() + feeding_begin[t + 1],
                [&](int a, int b) {
                  return std::pair(plan.tasks[a].below, a) > std::pair(plan.tasks[b].below, b);
                });
  }
};

Passes::Passes() = default;
Passes::~Passes() = default;

void Passes::set_threads(int threads) {
  threads = std::min(threads, tbb::info::default_concurrency());  // more would wait for each other
  if (threads == 1) {
    threads_.reset();
  } else if (!threads_ || threads_->count != threads) {
    threads_ = std::make_unique<Threads>(threads);
  }
  if (threads_) threads_->linked = false;
}

int Passes::threads() const { return threads_ ? threads_->count : 1; }

int Passes::slot() const { return threads_ ? tbb::this_task_arena::current_thread_index() : 0; }

void Passes::bottom_up(const SymbolicPlan& plan, IndexedBody body) {
  const std::size_t n = plan.tasks.size();
  if (!threads_) {
    for (std::size_t t = 0; t < n; ++t) body(t);
    return;
  }
  Threads& threads = *threads_;
  threads.start(plan);
  // A task that ends makes at most one other ready, so that who finds nothing may leave for good.
  const auto work = [&] {
    for (int task = threads.take(plan, -1); task >= 0; task = threads.take(plan, task))
      body(static_cast<std::size_t>(task));
  };
  threads.arena.execute([&] {
    tbb::task_group group;
    for (int t = 1; t < threads.count; ++t) group.run(work);
    work();
    group.wait();
  });
}

void Passes::top_down(const SymbolicPlan& plan, IndexedBody body) {
  const std::size_t n = plan.tasks.size();
  if (!threads_) {
    for (std::size_t t = n; t-- > 0;) body(t);
    return;
  }
  Threads& threads = *threads_;
  threads.link(plan);
  threads.arena.execute([&] {
    tbb::task_group group;
    const std::function<void(int)> descend = [&](int task) {
      while (task >= 0) {
        body(static_cast<std::size_t>(task));
        int next = -1;
        for (int k = threads.feeding_begin[task]; k < threads.feeding_begin[task + 1]; ++k) {
          const int child = threads.feeding[k];
          if (next < 0) {
            next = child;
          } else {
            group.run([&descend, child] { descend(child); });
          }
        }
        task = next;
      }
    };
    for (std::size_t t = 0; t < n; ++t)
      if (plan.tasks[t].parent < 0) group.run([&descend, t] { descend(static_cast<int>(t)); });
    group.wait();
  });
}

void Passes::for_chunks(std::size_t chunks, IndexedBody body) {
  if (!threads_ || chunks < 2) {
    for (std::size_t c = 0; c < chunks; ++c) body(c);
    return;
  }
  threads_->arena.execute(
      [&] { tbb::parallel_for(std::size_t{0}, chunks, [&](std::size_t c) { body(c); }); });
}

}  // namespace fastloop::optimization::block
