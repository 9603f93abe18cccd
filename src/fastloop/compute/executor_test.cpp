#include "fastloop/compute/executor.hpp"

#include <gtest/gtest.h>

#include <atomic>
#include <stdexcept>
#include <vector>

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

}  // namespace
}  // namespace fastloop
