#include "fastloop/compute/worker_team.hpp"

#include <tbb/task_arena.h>

#include <algorithm>
#include <chrono>

namespace fastloop {
namespace {

thread_local WorkerTeam* team_on_shift = nullptr;
thread_local bool in_pass = false;

void pause() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

/// Waiting that costs little time at first and no one else's later.
class Patience {
 public:
  void wait() {
    for (int i = 0; i < 8; ++i) pause();
    if (++rounds_ % 64 == 0 && !tired_)
      tired_ = std::chrono::steady_clock::now() - begin_ > std::chrono::microseconds(50);
    if (tired_) std::this_thread::yield();
  }
  bool tired() const { return tired_; }

 private:
  std::chrono::steady_clock::time_point begin_ = std::chrono::steady_clock::now();
  unsigned rounds_ = 0;
  bool tired_ = false;
};

}  // namespace

WorkerTeam::WorkerTeam(unsigned helpers) : num_helpers_(helpers) {}

WorkerTeam::~WorkerTeam() {
  wake(State::kStopped);
  for (std::thread& t : helpers_) t.join();
}

WorkerTeam& WorkerTeam::process_wide() {
  // oneTBB knows how many cores this process may use.
  static WorkerTeam team(static_cast<unsigned>(
      std::clamp(tbb::this_task_arena::max_concurrency() - 1, 0, 7)));
  return team;
}

WorkerTeam* WorkerTeam::on_shift() { return team_on_shift; }
bool WorkerTeam::within_pass() { return in_pass; }

void WorkerTeam::start() {
  while (helpers_.size() < num_helpers_) helpers_.emplace_back([this] { help(); });
}

void WorkerTeam::wake(State state) {
  state_ = state;
  state_.notify_all();
}

WorkerTeam::Shift::Shift(WorkerTeam& team) {
  if (team.num_helpers_ == 0 || team_on_shift || in_pass || team.taken_.exchange(true)) return;
  team_ = team_on_shift = &team;
  team.start();
  team.wake(State::kAwake);
}

WorkerTeam::Shift::~Shift() {
  if (!team_) return;
  team_on_shift = nullptr;
  team_->wake(State::kAsleep);
  team_->taken_ = false;
}

WorkerTeam::Rest::Rest() : team_(team_on_shift) {
  if (!team_) return;
  team_on_shift = nullptr;
  team_->wake(State::kResting);
}

WorkerTeam::Rest::~Rest() {
  if (!team_) return;
  team_->wake(State::kAwake);
  team_on_shift = team_;
}

void WorkerTeam::help() {
  in_pass = true;
  std::uint64_t seen = 0;
  for (;;) {
    doze();
    for (Patience patience; state_.load(std::memory_order_relaxed) == State::kAwake;) {
      const std::uint64_t pass = open_.load(std::memory_order_relaxed);
      if (pass == 0 || pass == seen) {
        patience.wait();
        continue;
      }
      seen = pass;
      // Either the caller sees this helper inside and waits, or this helper sees the pass closed.
      ++inside_;
      if (open_.load() == pass) take_ranges();
      inside_.fetch_sub(1, std::memory_order_release);
      patience = {};
    }
    if (state_ == State::kStopped) return;
  }
}

/// The next shift often follows at once: what one has found another applies.
void WorkerTeam::doze() {
  for (Patience patience; state_ == State::kAsleep && !patience.tired();) patience.wait();
  for (;;) {
    const State state = state_;
    if (state == State::kAwake || state == State::kStopped) return;
    state_.wait(state);
  }
}

void WorkerTeam::take_ranges() {
  for (;;) {
    const std::size_t begin = next_.fetch_add(grain_, std::memory_order_relaxed);
    if (begin >= n_) return;
    try {
      (*body_)(begin, std::min(begin + grain_, n_));
    } catch (...) {
      next_.store(n_, std::memory_order_relaxed);
      const std::lock_guard lock(failure_mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }
}

void WorkerTeam::run(std::size_t n, std::size_t grain, const Body& body) {
  n_ = n;
  grain_ = std::max<std::size_t>(1, grain);
  body_ = &body;
  next_.store(0, std::memory_order_relaxed);
  open_.store(++passes_);
  in_pass = true;
  take_ranges();
  in_pass = false;
  open_.store(0);
  for (Patience patience; inside_.load() != 0;) patience.wait();
  if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
}

}  // namespace fastloop
