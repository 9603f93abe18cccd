#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace fastloop {

/// Helper threads that stay awake while one thread works through many short passes. They begin a
/// pass within a microsecond; sleeping workers of oneTBB need 20 to 50, as much as many a pass of a
/// loop closure takes. (From 2022 on oneTBB keeps workers awake itself, as "parallel phases"; the
/// versions of Debian 12 and Ubuntu 24.04 do not.)
///
/// A thread begins a Shift; until its end Executor::for_ranges of this thread runs here. Helpers
/// burn their cores meanwhile, but yield them to others whenever nothing has come for 50 us.
class WorkerTeam {
 public:
  using Body = std::function<void(std::size_t, std::size_t)>;

  /// @param helpers  threads beside the one that has a shift; they start with the first shift
  explicit WorkerTeam(unsigned helpers);
  ~WorkerTeam();
  WorkerTeam(const WorkerTeam&) = delete;
  WorkerTeam& operator=(const WorkerTeam&) = delete;

  /// As many helpers as the process has cores beside one, seven at most.
  static WorkerTeam& process_wide();

  /// Keeps helpers awake for this thread. One thread at a time has them: while they serve another,
  /// and within a shift of the same thread, a further one changes nothing.
  class Shift {
   public:
    explicit Shift(WorkerTeam& team = process_wide());
    ~Shift();
    Shift(const Shift&) = delete;
    Shift& operator=(const Shift&) = delete;

   private:
    WorkerTeam* team_ = nullptr;
  };

  /// Lets the helpers of this thread's shift, if it has one, sleep for a step that has workers of
  /// its own.
  class Rest {
   public:
    Rest();
    ~Rest();
    Rest(const Rest&) = delete;
    Rest& operator=(const Rest&) = delete;

   private:
    WorkerTeam* team_ = nullptr;
  };

  /// The team whose helpers wait for this thread's passes, or null.
  static WorkerTeam* on_shift();
  /// Whether this thread runs a range of a pass: what is within is not divided again.
  static bool within_pass();

  /// Calls body(begin, end) on ranges of `grain` (the last may be shorter) that cover [0, n), in the
  /// calling thread and its helpers. The first exception propagates to the caller when all have
  /// stopped. Only from the thread that has the shift, not from within a body.
  void run(std::size_t n, std::size_t grain, const Body& body);

 private:
  enum class State : int { kResting, kAsleep, kAwake, kStopped };

  void start();
  void wake(State state);
  void help();
  void doze();
  void take_ranges();

  const unsigned num_helpers_;
  std::vector<std::thread> helpers_;
  std::atomic<bool> taken_ = false;  ///< a thread has the shift
  std::atomic<State> state_ = State::kAsleep;

  // The pass at hand. Helpers read it between counting themselves in and out, if it is open then.
  alignas(64) std::atomic<std::uint64_t> open_ = 0;  ///< number of the pass, 0: none
  alignas(64) std::atomic<int> inside_ = 0;          ///< helpers that may be reading it
  alignas(64) std::atomic<std::size_t> next_ = 0;    ///< first range that nobody has taken
  std::size_t n_ = 0, grain_ = 1;
  const Body* body_ = nullptr;
  std::uint64_t passes_ = 0;
  std::mutex failure_mutex_;
  std::exception_ptr failure_;
};

}  // namespace fastloop
