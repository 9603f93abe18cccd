#include <gtest/gtest.h>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/loop/loop_replay.hpp"
#include "simulated_loop.hpp"

/// Whole loops on a device session of their own: how often the host waits, and what happens when the
/// device fails in the middle.
namespace fastloop::loop {
namespace {

using testing::Attempt;
using testing::describe;
using testing::small_world;

TEST(LoopOnDevice, HostWaitsAHandfulOfTimes) {
  const auto session = CudaSession::open();
  if (!session) GTEST_SKIP() << "no CUDA device";
  Attempt first(small_world(), Backend::kCuda, Executor::cuda(session));
  ASSERT_TRUE(first.outcome.correction.has_value()) << describe(first.outcome.report);
  // Once more, now that all memory is there.
  const auto snapshot = first.world.map.publish();
  first.closer.forget(first.world.current);
  const CudaCounters before = session->counters();
  const auto again = first.closer.process(*snapshot, first.world.current);
  const CudaCounters after = session->counters();
  EXPECT_EQ(decision_digest(again), decision_digest(first.outcome));
  // Ranking, matching, RANSAC, PS2a, PS2b, PS3, fusion; the pose graph has a session of its own.
  EXPECT_LE(after.synchronizations - before.synchronizations, 8u);
  EXPECT_LE(after.launches - before.launches, 24u);
  EXPECT_EQ(after.allocations, before.allocations);
}

TEST(LoopOnDevice, WhatTheDeviceDoesNotFinishTheCpuDoes) {
  if (!CudaSession::open()) GTEST_SKIP() << "no CUDA device";
  const Attempt cpu(small_world(), Backend::kCpu);
  ASSERT_TRUE(cpu.outcome.correction.has_value());
  for (const bool lost : {false, true})
    for (const int call : {1, 2, 7, 400, 1000, 1250, 1300, 1320, 1340}) {
      SCOPED_TRACE(::testing::Message() << (lost ? "lost at " : "out of memory at ") << call);
      const auto session = CudaSession::open();
      session->inject_failure(call, lost);
      const Attempt other(small_world(), Backend::kCuda, Executor::cuda(session));
      EXPECT_EQ(decision_digest(other.outcome), decision_digest(cpu.outcome));
      EXPECT_LT(largest_pose_difference(other.outcome, cpu.outcome), 1e-6);
    }
}

TEST(LoopWithoutDevice, CudaAndAutoAreTheCpu) {
  if (CudaSession::open()) GTEST_SKIP() << "there is a CUDA device";
  for (const Backend b : {Backend::kCuda, Backend::kAuto}) {
    EXPECT_EQ(resolve(b), Backend::kCpu);
    EXPECT_EQ(executors_of(b).device().kind(), Executor::Kind::kCpu);
    EXPECT_EQ(executors_of(b).of(Step::kProjection, 1e12).kind(), Executor::Kind::kCpu);
  }
}

}  // namespace
}  // namespace fastloop::loop
