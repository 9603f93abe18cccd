#include "fastloop/core/process_memory.hpp"

#include <fstream>
#include <string>

namespace fastloop {

ProcessMemory process_memory() {
  ProcessMemory memory;
  std::ifstream status("/proc/self/status");
  for (std::string key; status >> key;) {
    double kibibytes = 0;
    if (key == "VmRSS:" && status >> kibibytes) memory.resident_mib = kibibytes / 1024;
    if (key == "VmHWM:" && status >> kibibytes) memory.peak_mib = kibibytes / 1024;
  }
  return memory;
}

}  // namespace fastloop
