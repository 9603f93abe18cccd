#pragma once

namespace fastloop {

/// Memory of this process as the system counts it, MiB. Zero where the system does not tell
/// (anything but Linux).
struct ProcessMemory {
  double resident_mib = 0;
  double peak_mib = 0;  ///< largest resident size since the process began
};
ProcessMemory process_memory();

}  // namespace fastloop
