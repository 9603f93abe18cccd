#pragma once

#include <cstdint>
#include <memory>
#include <mutex>
#include <span>
#include <string>
#include <utility>

#include "fastloop/optimization/block_kernels.hpp"
#include "fastloop/optimization/pose_graph_schedule.hpp"

namespace fastloop::optimization::device {

/// Where the numbers of a problem go before they are handed over; memory of the executor.
struct Numbers {
  double* poses = nullptr;              ///< [poses][8]
  double* measurement = nullptr;        ///< [edges][8]
  std::int32_t* information = nullptr;  ///< [edges], see View
  double* matrices = nullptr;           ///< [matrices][28]
};

/// Runs the passes of one schedule. Two exist: the device, and a loop on the host over the same
/// functions, which is how machines without a device test them.
class StepExecutor {
 public:
  virtual ~StepExecutor() = default;
  /// Held for the duration of a solve.
  virtual std::unique_lock<std::mutex> lock() { return {}; }
  /// A call below threw: logs it, once for each kind.
  virtual void report_failure(const std::string&) {}
  /// Launches and waits of the host so far.
  virtual std::pair<std::uint64_t, std::uint64_t> launches_and_waits() const { return {0, 0}; }
  /// Largest front that is treated as one piece.
  virtual std::size_t max_shared_doubles() const = 0;
  virtual void set_schedule(const Schedule& schedule, block::EdgeModel model) = 0;
  virtual Numbers stage(std::size_t poses, std::size_t edges, std::size_t matrices) = 0;
  /// Takes what was staged for the present schedule, and evaluates it: the cost.
  virtual double start(int robust_kernel, double robust_width) = 0;
  /// `information` changed: the cost again, at the present poses.
  virtual double restart(int robust_kernel) = 0;
  /// A step from the present poses, with a new factor or with the old one.
  virtual StepResult factor_step(double lambda) = 0;
  virtual StepResult old_factor_step() = 0;
  /// Makes the poses after the step the present ones.
  virtual void accept() = 0;
  /// Squared residuals by slot at the present poses.
  virtual void squared(std::span<double> out) = 0;
  /// [poses][8], valid until the next call.
  virtual const double* poses() = 0;
};

/// One thread, for tests and debugging. A small limit cuts small fronts into tiles, too.
std::unique_ptr<StepExecutor> make_host_executor(std::size_t max_shared_doubles = 28000);
/// The CUDA device of the process; null where there is none, which is logged once.
std::unique_ptr<StepExecutor> make_cuda_executor();

}  // namespace fastloop::optimization::device
