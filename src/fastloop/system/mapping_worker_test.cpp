#include "fastloop/system/mapping_worker.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>

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

MappingWorker make_worker(const WorkerPace& pace) {
  return MappingWorker(simple_rig(), PyramidScales(8, 1.2f), {}, pace, {}, {}, nullptr, nullptr);
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

/// A keyframe without any feature in the map of `reference`.
map::KeyframeRequest empty_keyframe(std::uint32_t id, std::uint32_t reference) {
  map::KeyframeRequest request = empty_start(id);
  request.starts_map = false;
  request.reference = KeyframeId(reference);
  return request;
}

class Worker : public ::testing::TestWithParam<WorkerPace> {};

TEST_P(Worker, ProcessesInOrderAndPublishes) {
  auto worker = make_worker(GetParam());
  EXPECT_TRUE(worker.view(0).idle);
  EXPECT_EQ(worker.view(0).snapshot->num_keyframes(), 0u);
  for (std::uint32_t i = 0; i < 6; ++i) {
    worker.submit(empty_start(i), i);
    EXPECT_EQ(worker.view(i + 1).snapshot->num_keyframes(), i + 1)
        << "the next frame needs the first keyframe of a map";
  }
  worker.finish();
  worker.finish();
  EXPECT_EQ(worker.snapshot()->maps().size(), 6u);
}

TEST_P(Worker, FinishWorksOffTheQueue) {
  auto worker = make_worker(GetParam());
  for (std::uint32_t i = 0; i < 20; ++i) worker.submit(empty_start(i), 0);
  worker.finish();
  EXPECT_EQ(worker.snapshot()->num_keyframes(), 20u);
  EXPECT_TRUE(worker.view(100).idle);
  EXPECT_EQ(worker.view(100).snapshot->num_keyframes(), 20u);
}

TEST_P(Worker, AnExceptionReachesTheCaller) {
  auto worker = make_worker(GetParam());
  worker.submit(empty_start(0), 0);
  EXPECT_THROW((worker.submit(empty_start(7), 1), worker.view(2), worker.finish()), Error);
  EXPECT_THROW(worker.finish(), Error);
  EXPECT_THROW(worker.submit(empty_start(1), 3), Error);
  EXPECT_EQ(worker.snapshot()->num_keyframes(), 1u) << "the map before the failure stays readable";
}

INSTANTIATE_TEST_SUITE_P(Pace, Worker,
                         ::testing::Values(WorkerPace{.threaded = false},
                                           WorkerPace{.threaded = true},
                                           WorkerPace{.threaded = true, .live = true}),
                         [](const auto& p) {
                           return p.param.live       ? "live"
                                  : p.param.threaded ? "threaded"
                                                     : "synchronous";
                         });

/// Frames that ask for a keyframe, in a map that starts at frame 0.
using Frames = std::vector<std::uint32_t>;

/// What tracking sees at a frame.
struct Seen {
  std::size_t keyframes = 0;
  bool fresh = false;  ///< another snapshot than one frame before
  bool idle = false;
  bool operator==(const Seen&) const = default;
};

std::vector<Seen> seen(const WorkerPace& pace, const Frames& keyframes, std::uint32_t num_frames) {
  auto worker = make_worker(pace);
  std::vector<Seen> all;
  std::uint32_t id = 0;
  std::shared_ptr<const map::Snapshot> before;
  for (std::uint32_t frame = 0; frame < num_frames; ++frame) {
    const auto view = worker.view(frame);
    all.push_back({view.snapshot->num_keyframes(), view.snapshot != before, view.idle});
    before = view.snapshot;
    if (frame == 0) worker.submit(empty_start(id++), frame);
    if (std::find(keyframes.begin(), keyframes.end(), frame) != keyframes.end()) {
      worker.submit(empty_keyframe(id, id - 1), frame);
      ++id;
    }
  }
  worker.finish();
  return all;
}

TEST(FrameClock, AKeyframeIsSeenByTheNextFrameAndItsMappingAfterTheDelay) {
  const auto frames = seen({.threaded = true, .delay_frames = 4}, {10}, 20);
  for (std::uint32_t frame = 6; frame < 20; ++frame) {
    EXPECT_EQ(frames[frame].keyframes, frame < 11 ? 1u : 2u) << frame;
    EXPECT_EQ(frames[frame].fresh, frame == 11 || frame == 14) << frame;
    EXPECT_EQ(frames[frame].idle, frame < 11 || frame >= 14) << frame;
  }
}

TEST(FrameClock, TheNextKeyframeIsNotSeenBeforeTheLastOneIsComplete) {
  const auto frames = seen({.threaded = true, .delay_frames = 4}, {10, 12}, 20);
  for (std::uint32_t frame = 6; frame < 20; ++frame) {
    EXPECT_EQ(frames[frame].keyframes, frame < 11 ? 1u : frame < 14 ? 2u : 3u) << frame;
    EXPECT_EQ(frames[frame].fresh, frame == 11 || frame == 14 || frame == 16) << frame;
  }
}

TEST(FrameClock, AStartedMapIsSeenByTheNextFrameWhateverIsUnderWay) {
  auto worker = make_worker({.threaded = true, .delay_frames = 10});
  worker.submit(empty_start(0), 0);
  worker.submit(empty_keyframe(1, 0), 3);
  worker.submit(empty_keyframe(2, 1), 4);
  EXPECT_EQ(worker.view(5).snapshot->num_keyframes(), 1u);
  worker.submit(empty_start(3), 5);
  EXPECT_EQ(worker.view(6).snapshot->num_keyframes(), 4u);
}

TEST(FrameClock, WhatTrackingSeesDoesNotDependOnThreads) {
  std::mt19937 random(5);
  for (int round = 0; round < 50; ++round) {
    const std::uint32_t delay = 1 + random() % 6;
    Frames keyframes;
    for (std::uint32_t frame = 1; frame < 40; ++frame)
      if (random() % 3 == 0) keyframes.push_back(frame);
    const auto one = seen({.threaded = false, .delay_frames = delay}, keyframes, 50);
    const auto two = seen({.threaded = true, .delay_frames = delay}, keyframes, 50);
    EXPECT_EQ(one, two) << "delay " << delay;
    EXPECT_EQ(one.back().keyframes, keyframes.size() + 1);
    EXPECT_TRUE(one.back().idle);
  }
}

TEST(ThreadedWorker, CanBeThrownAwayWithAFullQueue) {
  for (int run = 0; run < 50; ++run) {
    auto worker = make_worker({.threaded = true, .live = run % 2 == 0});
    for (std::uint32_t i = 0; i < 4; ++i) worker.submit(empty_start(i), i);
  }
}

}  // namespace
}  // namespace fastloop::system
