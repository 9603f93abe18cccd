#include <gtest/gtest.h>

#include <opencv2/core/utility.hpp>

namespace fastloop {
namespace {

/// The tests of this program run OpenCV as FrameBuilder does, with one thread.
class OneOpenCvThread : public testing::Environment {
  void SetUp() override { cv::setNumThreads(1); }
};

[[maybe_unused]] const testing::Environment* const environment =
    testing::AddGlobalTestEnvironment(new OneOpenCvThread);

}  // namespace
}  // namespace fastloop
