#pragma once

#include "fastloop/compute/executor.hpp"
#include "fastloop/loop/cost_model.hpp"

namespace fastloop::loop {

/// The executor of each step: the same for all, or, where the back end is chosen automatically, the
/// one that a cost model expects to be faster for the amount of work at hand. Results do not depend
/// on the choice.
class StepExecutors {
 public:
  /// The same for every step; implicit, so that one executor can be given instead.
  StepExecutors(const Executor& executor) : host_(executor), device_(executor) {}
  /// @param device  of kind kCuda
  StepExecutors(const Executor& host, const Executor& device, const CostModel& costs)
      : host_(host), device_(device), costs_(costs), choosing_(true) {}

  /// @param work  in the units of the step
  const Executor& of(Step step, double work) const {
    return !choosing_ || costs_.device_wins(step, work) ? device_ : host_;
  }
  /// For loops that have no device version.
  const Executor& host() const { return host_; }
  /// The one that may have a device.
  const Executor& device() const { return device_; }
  /// Whether of() depends on the work.
  bool choosing() const { return choosing_; }
  bool reference() const { return host_.sequential(); }

 private:
  Executor host_, device_;
  CostModel costs_;
  bool choosing_ = false;
};

}  // namespace fastloop::loop
