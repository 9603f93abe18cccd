// What the system does with input that real devices deliver on bad days: a defined outcome, never a crash.
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/io/run_output.hpp"
#include "simulated_run.hpp"

namespace fastloop::tests {
namespace {

using sim::CameraKind;
using system::Mode;
using system::System;
using tracking::State;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

std::string reason_of(const System& system, const std::string& kind) {
  for (const auto& e : system.events())
    if (e.kind == kind) return e.reason;
  return "";
}

TEST(Robustness, LensCoveredForASecondIsRelocalised) {
  Recording recording(CameraKind::kPinhole, 4);
  cover_lens(recording, 1.2, 2.2);
  System system(recording.sequence.calibration(), small_options(Mode::kStereo));
  feed(system, recording);
  EXPECT_EQ(count_events(system, "recently_lost"), 1u);
  EXPECT_NE(reason_of(system, "recently_lost"), "");
  EXPECT_EQ(count_events(system, "relocalised"), 1u);
  EXPECT_NE(reason_of(system, "relocalised"), "");
  EXPECT_EQ(count_tracked(system), recording.frames.size() - 20) << "relocalised by the first frame with light";
  EXPECT_EQ(system.snapshot()->maps().size(), 1u);
  EXPECT_EQ(system.frames().back().state, State::kTracking);
  EXPECT_LT(ate_m(system, recording.sequence), 0.1);
}

TEST(Robustness, LensCoveredForLongStartsANewMapAndKeepsTheOld) {
  Recording recording(CameraKind::kPinhole, 12);
  cover_lens(recording, 2, 10);
  System system(recording.sequence.calibration(), small_options(Mode::kStereo));
  feed(system, recording);
  EXPECT_EQ(count_events(system, "lost"), 1u);
  EXPECT_NE(reason_of(system, "lost"), "");
  EXPECT_EQ(count_events(system, "initialised"), 2u);
  const auto map = system.snapshot();
  ASSERT_EQ(map->maps().size(), 2u);
  EXPECT_GT(map->map_info(MapId(0)).num_keyframes, 1u);
  EXPECT_EQ(system.frames().back().state, State::kTracking);
  // Each part is a trajectory of its own.
  const std::size_t before = 2 * 20, after = 10 * 20 + 1;
  EXPECT_LT(ate_m(system, recording.sequence, 0, before), 0.1);
  EXPECT_LT(ate_m(system, recording.sequence, after), 0.1);

  const auto folder = std::filesystem::path(::testing::TempDir()) / "fastloop_robustness_two_maps";
  io::prepare_output_folder(folder);
  io::write_run_output(folder, system, {});
  EXPECT_GT(std::filesystem::file_size(folder / "trajectory_body.txt"), 1000u);
  std::filesystem::remove_all(folder);
}

TEST(Robustness, LensCoveredWithImuFindsBackOrStartsAgain) {
  for (const double seconds : {1.0, 8.0}) {
    Recording recording(CameraKind::kPinhole, 7 + seconds);
    cover_lens(recording, 5, 5 + seconds);
    System system(recording.sequence.calibration(), small_options(Mode::kStereoInertial));
    feed(system, recording);
    EXPECT_EQ(system.frames().back().state, State::kTracking) << seconds;
    EXPECT_EQ(count_events(system, "recently_lost"), 1u) << seconds;
    EXPECT_EQ(system.snapshot()->maps().size(), seconds > 5 ? 2u : 1u) << seconds;
    for (const auto& f : system.frames())
      EXPECT_TRUE(!f.has_pose || f.live_T_world_body.is_finite());
  }
}

TEST(Robustness, ImagesOfAnotherSizeAreRefusedAndTheRunGoesOn) {
  const Recording recording(CameraKind::kPinhole, 1);
  System system(recording.sequence.calibration(), small_options());
  for (std::size_t i = 0; i < recording.frames.size(); ++i) {
    if (i == 5) {
      FrameInput bad = recording.frames[i];
      bad.right = ImageU8(bad.right.width / 2, bad.right.height / 2);
      EXPECT_THROW(system.process(bad), InvalidArgument);
      FrameInput empty = recording.frames[i];
      empty.left = {};
      EXPECT_THROW(system.process(empty), InvalidArgument);
    }
    system.process(recording.frames[i]);
  }
  system.finish();
  EXPECT_EQ(count_tracked(system), recording.frames.size());
}

TEST(Robustness, FramesOutOfOrderAreRefusedAndTheRunGoesOn) {
  const Recording recording(CameraKind::kPinhole, 1);
  System system(recording.sequence.calibration(), small_options());
  for (std::size_t i = 0; i < recording.frames.size(); ++i) {
    system.process(recording.frames[i]);
    if (i == 4) {
      EXPECT_THROW(system.process(recording.frames[i]), InvalidArgument);
      EXPECT_THROW(system.process(recording.frames[2]), InvalidArgument);
    }
  }
  system.finish();
  EXPECT_EQ(count_tracked(system), recording.frames.size());
}

TEST(Robustness, FramesAfterTheEndAreRefused) {
  const Recording recording(CameraKind::kPinhole, 0.5);
  for (const bool deterministic : {true, false}) {
    auto options = small_options();
    options.deterministic = deterministic;
    System system(recording.sequence.calibration(), options);
    system.process(recording.frames[0]);
    system.finish();
    system.finish();
    EXPECT_THROW(system.process(recording.frames[1]), InvalidArgument);
    EXPECT_EQ(system.frames().size(), 1u);
  }
}

TEST(Robustness, AGapInTheImuDoesNotStopTracking) {
  Recording recording(CameraKind::kPinhole, 9);
  for (FrameInput& f : recording.frames) {
    const double t = to_seconds(f.stamp_ns - recording.frames.front().stamp_ns);
    if (t > 6 && t < 7) f.imu.clear();
  }
  System system(recording.sequence.calibration(), small_options(Mode::kStereoInertial));
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_LT(ate_m(system, recording.sequence), 0.1);
}

TEST(Robustness, ARunWithoutAnyImuSampleIsAStereoRun) {
  Recording recording(CameraKind::kPinhole, 3);
  for (FrameInput& f : recording.frames) f.imu.clear();
  System system(recording.sequence.calibration(), small_options(Mode::kStereoInertial));
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_FALSE(system.imu_initialized());
}

TEST(Robustness, NonFiniteImuSamplesAreIgnoredWithAnEvent) {
  Recording recording(CameraKind::kPinhole, 6);
  for (const std::size_t i : {std::size_t{0}, std::size_t{30}, std::size_t{100}}) {
    ASSERT_GT(recording.frames[i].imu.size(), 0u);
    recording.frames[i].imu.back().gyro.x() = kNan;
    recording.frames[i].imu.front().accel.z() = std::numeric_limits<double>::infinity();
  }
  System system(recording.sequence.calibration(), small_options(Mode::kStereoInertial));
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_EQ(count_events(system, "imu_ignored"), 3u);
  EXPECT_LT(ate_m(system, recording.sequence), 0.1);
}

TEST(Robustness, ImuSamplesOutOfOrderAreIgnored) {
  Recording recording(CameraKind::kPinhole, 4);
  for (FrameInput& f : recording.frames)
    if (f.imu.size() > 4) std::swap(f.imu[1], f.imu[3]);
  System system(recording.sequence.calibration(), small_options(Mode::kStereoInertial));
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
}

TEST(Robustness, BlankImagesNeverInitialise) {
  Recording recording(CameraKind::kPinhole, 1);
  cover_lens(recording, 0, 2);
  System system(recording.sequence.calibration(), small_options());
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), 0u);
  EXPECT_EQ(system.snapshot()->num_keyframes(), 0u);
  // The reason is told once, not with every frame.
  EXPECT_EQ(count_events(system, "initialising"), 1u);
  EXPECT_NE(reason_of(system, "initialising").find("keypoints"), std::string::npos);
}

TEST(Robustness, SystemsCanBeThrownAwayInTheMiddle) {
  const Recording recording(CameraKind::kPinhole, 1.5);
  auto options = small_options();
  options.deterministic = false;
  // A different number of frames each time: mapping is caught at a different step.
  for (std::size_t run = 0; run < 50; ++run) {
    System system(recording.sequence.calibration(), options);
    const std::size_t count = run % 7;
    for (std::size_t i = 0; i < count; ++i) system.process(recording.frames[i * 4]);
  }
}

}  // namespace
}  // namespace fastloop::tests
