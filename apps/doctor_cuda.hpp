#pragma once

namespace fastloop::apps {

/// Prints devices, memory and driver, and what the back end auto would choose for maps of several
/// sizes.
void print_cuda();

/// Measures what the steps of loop closing cost on the CPU and on the device, and stores it for
/// auto. Prints the figures; without a device it says so and changes nothing.
void calibrate_costs();

}  // namespace fastloop::apps
