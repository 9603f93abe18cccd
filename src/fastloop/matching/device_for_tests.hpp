#pragma once

#include <gtest/gtest.h>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/matching/projection_search.hpp"

namespace fastloop::matching::testing {

/// Tests that need a device: each has a session of its own, so that counters begin at 0 and injected
/// failures stay inside. Skipped without a device.
class OnDevice : public ::testing::Test {
 protected:
  void SetUp() override {
    std::string reason;
    session_ = CudaSession::open(&reason);
    if (!session_) GTEST_SKIP() << "no CUDA device: " << reason;
  }
  Executor device() const { return Executor::cuda(session_); }

  std::shared_ptr<CudaSession> session_;
};

}  // namespace fastloop::matching::testing
