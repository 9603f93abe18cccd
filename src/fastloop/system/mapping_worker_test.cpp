#include "fastloop/system/mapping_worker.hpp"

#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"

namespace fastloop::system {
namespace {

StereoRig simple_rig() {
  StereoRig rig;
  rig.left.width = 320;
  rig.left.height = 240;
  rig.left.fx = rig.left.fy = 200;
  rig.left.cx = 160;
  rig.left.cy = 120;
  rig.right = rig.left;
  rig.baseline_m = 0.1;
  rig.T_right_left = SE3(Eigen::Quaterniond::Identity(), Vector3d(-0.1, 0, 0));
  return rig;
}

MappingWorker make_worker(bool threaded) {
  return MappingWorker(simple_rig(), PyramidScales(8, 1.2f), {}, threaded, {}, nullptr);
}

/// A keyframe without any feature that starts a map.
map::KeyframeRequest empty_start(std::uint32_t id) {
  map::KeyframeRequest request;
  auto features = std::make_shared<FeatureSet>();
  features->image_width = 320;
  features->image_height = 240;
  features->grid.build({}, {}, 320, 240);
  auto data = std::make_shared<map::KeyframeData>();
  data->stamp_ns = 1000 + id;
  data->features = std::move(features);
  request.id = KeyframeId(id);
  request.data = std::move(data);
  request.starts_map = true;
  return request;
}

class Worker : public ::testing::TestWithParam<bool> {};

TEST_P(Worker, ProcessesInOrderAndPublishes) {
  auto worker = make_worker(GetParam());
  EXPECT_TRUE(worker.idle());
  EXPECT_EQ(worker.snapshot()->num_keyframes(), 0u);
  for (std::uint32_t i = 0; i < 6; ++i) {
    worker.submit(empty_start(i), true);
    EXPECT_EQ(worker.snapshot()->num_keyframes(), i + 1);
    EXPECT_TRUE(worker.idle());
  }
  worker.finish();
  worker.finish();
  EXPECT_EQ(worker.snapshot()->maps().size(), 6u);
}

TEST_P(Worker, FinishWorksOffTheQueue) {
  auto worker = make_worker(GetParam());
  for (std::uint32_t i = 0; i < 20; ++i) worker.submit(empty_start(i), false);
  worker.finish();
  EXPECT_EQ(worker.snapshot()->num_keyframes(), 20u);
}

TEST_P(Worker, AnExceptionReachesTheCallerWhoWaits) {
  auto worker = make_worker(GetParam());
  worker.submit(empty_start(0), true);
  EXPECT_THROW(worker.submit(empty_start(7), true), Error);
  EXPECT_EQ(worker.snapshot()->num_keyframes(), 1u) << "the map before the failure stays readable";
}

INSTANTIATE_TEST_SUITE_P(Threading, Worker, ::testing::Bool(),
                         [](const auto& p) { return p.param ? "threaded" : "synchronous"; });

TEST(ThreadedWorker, AnExceptionIsRethrownByWhatComesNext) {
  auto worker = make_worker(true);
  worker.submit(empty_start(5), false);
  EXPECT_THROW(worker.finish(), Error);
  EXPECT_THROW(worker.submit(empty_start(1), true), Error);
  EXPECT_THROW(worker.submit(empty_start(2), false), Error);
}

TEST(ThreadedWorker, CanBeThrownAwayWithAFullQueue) {
  for (int run = 0; run < 50; ++run) {
    auto worker = make_worker(true);
    for (std::uint32_t i = 0; i < 4; ++i) worker.submit(empty_start(i), false);
  }
}

}  // namespace
}  // namespace fastloop::system
