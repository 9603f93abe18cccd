#include <gtest/gtest.h>

#include <atomic>
#include <cstdlib>
#include <new>

#include "fastloop/optimization/pose_graph.hpp"
#include "fastloop/optimization/pose_graph_test_support.hpp"

namespace {
std::atomic<long> allocations{0};
}

// Counts what the whole test program allocates through operator new.
void* operator new(std::size_t size) {
  ++allocations;
  if (void* p = std::malloc(size == 0 ? 1 : size)) return p;
  throw std::bad_alloc();
}
void* operator new(std::size_t size, const std::nothrow_t&) noexcept {
  ++allocations;
  return std::malloc(size == 0 ? 1 : size);
}
void operator delete(void* p) noexcept {
  std::free(p);
}
void operator delete(void* p, std::size_t) noexcept {
  std::free(p);
}
void operator delete(void* p, const std::nothrow_t&) noexcept {
  std::free(p);
}

namespace fastloop::optimization {
namespace {

TEST(PoseGraphAllocation, KeptPlanAllocatesNothing) {
  for (auto kind : {PoseGraphKind::kYaw, PoseGraphKind::kSe3, PoseGraphKind::kSim3}) {
    testing::Random random(1);
    testing::RandomGraphOptions options;
    options.kind = kind;
    options.poses = 300;
    const PoseGraphProblem start = testing::random_graph(random, options);
    PoseGraphProblem p = start;
    PoseGraphPlan plan;
    PoseGraphResult result;
    const long before_first = allocations;
    solve_pose_graph(p, {}, &plan, result);
    EXPECT_GT(allocations - before_first, 10);
    p.poses = start.poses;
    const long before = allocations;
    solve_pose_graph(p, {}, &plan, result);
    EXPECT_EQ(allocations - before, 0);
    EXPECT_TRUE(result.plan_reused);
  }
}

}  // namespace
}  // namespace fastloop::optimization
