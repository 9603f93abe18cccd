#include "fastloop/compute/executor.hpp"

#include <gtest/gtest.h>

#include <atomic>
#include <stdexcept>
#include <vector>

#include "fastloop/compute/cuda_session.hpp"

namespace fastloop {
namespace {

TEST(Executor, CoversEveryIndexOnce) {
  for (const Executor& executor : {Executor::reference(), Executor::cpu()})
    for (std::size_t n : {0u, 1u, 7u, 1000u}) {
      std::vector<std::atomic<int>> hits(n);
      executor.for_ranges(n, 16, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) ++hits[i];
      });
      for (const auto& h : hits) EXPECT_EQ(h.load(), 1);
    }
}

TEST(Executor, ExceptionsReachTheCaller) {
  for (const Executor& executor : {Executor::reference(), Executor::cpu()})
    EXPECT_THROW(executor.for_ranges(
                     100, 1, [](std::size_t, std::size_t) { throw std::runtime_error("x"); }),
                 std::runtime_error);
}

TEST(CudaSession, CountersOfTheSharedSessionExistOnceItWasAskedFor) {
  EXPECT_FALSE(CudaSession::process_wide_counters());
  const auto session = CudaSession::process_wide();
  EXPECT_EQ(CudaSession::process_wide_counters().has_value(), session != nullptr);
}

}  // namespace
}  // namespace fastloop
