#pragma once

#include <cstddef>
#include <functional>

namespace fastloop {

/// Where a data-parallel step runs. A value: cheap to copy, safe to share between threads.
class Executor {
 public:
  enum class Kind : int {
    kReference,  ///< plain loop in the calling thread
    kCpu,        ///< oneTBB
  };
  static Executor reference() { return Executor(Kind::kReference); }
  static Executor cpu() { return Executor(Kind::kCpu); }

  Kind kind() const { return kind_; }

  /// Calls body(begin, end) on disjoint ranges that cover [0, n). `grain` is the smallest range
  /// worth a task. Bodies must not depend on how the range is cut. Exceptions propagate to the
  /// caller.
  void for_ranges(std::size_t n, std::size_t grain,
                  const std::function<void(std::size_t, std::size_t)>& body) const;

 private:
  explicit Executor(Kind kind) : kind_(kind) {}
  Kind kind_;
};

}  // namespace fastloop
