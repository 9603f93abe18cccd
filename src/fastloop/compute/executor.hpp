#pragma once

#include <cstddef>
#include <functional>
#include <memory>

namespace fastloop {

class CudaSession;

/// Where a data-parallel step runs. A value: cheap to copy, safe to share between threads.
class Executor {
 public:
  enum class Kind : int {
    kReference,  ///< plain loop in the calling thread
    kCpu,        ///< oneTBB
    kCuda,       ///< steps that have a device version run there, everything else as kCpu
  };
  static Executor reference() { return Executor(Kind::kReference); }
  static Executor cpu() { return Executor(Kind::kCpu); }
  /// @param session  null: the same as cpu()
  static Executor cuda(std::shared_ptr<CudaSession> session) {
    Executor executor(session ? Kind::kCuda : Kind::kCpu);
    executor.session_ = std::move(session);
    return executor;
  }

  Kind kind() const { return kind_; }
  /// Runs one thing after the other in the calling thread.
  bool sequential() const { return kind_ == Kind::kReference; }
  /// For passes of some microseconds: this executor while helpers are awake for the calling thread
  /// (WorkerTeam), otherwise a plain loop.
  Executor for_short_passes() const;
  /// Not null exactly for kCuda.
  CudaSession* cuda_session() const { return session_.get(); }

  /// Calls body(begin, end) on disjoint ranges that cover [0, n). `grain` is the smallest range
  /// worth a task. Bodies must not depend on how the range is cut. Exceptions propagate to the
  /// caller.
  void for_ranges(std::size_t n, std::size_t grain,
                  const std::function<void(std::size_t, std::size_t)>& body) const;

 private:
  explicit Executor(Kind kind) : kind_(kind) {}
  Kind kind_;
  std::shared_ptr<CudaSession> session_;
};

}  // namespace fastloop
