#pragma once

#include "fastloop/loop/backend.hpp"

namespace fastloop::apps {

/// Times the steps of loop closing on the CPU and on the device, each with little and with much
/// work, and draws a line through the two. Takes some seconds.
loop::CostModel measure_costs(const Executor& cpu, const Executor& device);

}  // namespace fastloop::apps
