#include "fastloop/core/process_memory.hpp"

#include <gtest/gtest.h>

#include <vector>

namespace fastloop {
namespace {

TEST(ProcessMemory, GrowsByWhatIsWritten) {
  const ProcessMemory before = process_memory();
  if (before.resident_mib == 0) GTEST_SKIP() << "this system does not tell";
  std::vector<char> block(200u << 20, 1);
  const ProcessMemory with = process_memory();
  EXPECT_GT(with.resident_mib, before.resident_mib + 190);
  EXPECT_GE(with.peak_mib, with.resident_mib - 1);
  block = {};
  EXPECT_GE(process_memory().peak_mib, with.peak_mib);
}

}  // namespace
}  // namespace fastloop
