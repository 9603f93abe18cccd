#pragma once

#include <cstddef>
#include <cstdlib>
#include <memory>
#include <type_traits>

#include "fastloop/optimization/block_plan.hpp"

namespace fastloop::optimization::block {

/// Doubles aligned to cache lines, grown but never shrunk, not initialised.
class Buffer {
 public:
  void resize(std::size_t size);
  double* data() { return data_.get(); }
  const double* data() const { return data_.get(); }
  double& operator[](std::size_t i) { return data_[i]; }
  double operator[](std::size_t i) const { return data_[i]; }

 private:
  struct Free {
    void operator()(double* p) const { std::free(p); }
  };
  std::unique_ptr<double[], Free> data_;
  std::size_t capacity_ = 0;
};

/// Reference to something callable with an index; does not own or allocate.
class IndexedBody {
 public:
  template <class F>
  requires(!std::is_same_v<std::remove_cvref_t<F>, IndexedBody>)
      IndexedBody(F&& f)  // NOLINT: implicit on purpose, a parameter type only
      : object_(const_cast<void*>(static_cast<const void*>(&f))),
        call_([](void* object, std::size_t i) {
          (*static_cast<std::remove_reference_t<F>*>(object))(i);
        }) {}
  void operator()(std::size_t i) const { call_(object_, i); }

 private:
  void* object_;
  void (*call_)(void*, std::size_t);
};

/// Runs passes over the task tree and over ranges, on the calling thread or on an arena of oneTBB.
/// What is computed does not depend on the number of threads: tasks own their memory, and sums are
/// taken over fixed ranges.
class Passes {
 public:
  Passes();
  ~Passes();
  /// At the beginning of a call: the passes that follow are over one plan.
  void set_threads(int threads);
  int threads() const;
  /// Number of the calling thread among those of a pass, in [0, threads()).
  int slot() const;
  /// Calls body(task) after all tasks that feed it.
  void bottom_up(const SymbolicPlan& plan, IndexedBody body);
  /// Calls body(task) after the task it feeds.
  void top_down(const SymbolicPlan& plan, IndexedBody body);
  /// Calls body(chunk) for all chunks.
  void for_chunks(std::size_t chunks, IndexedBody body);

 private:
  struct Threads;
  std::unique_ptr<Threads> threads_;  // null: the calling thread
};

}  // namespace fastloop::optimization::block
