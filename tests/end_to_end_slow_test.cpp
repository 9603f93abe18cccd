// The whole system on simulated recordings with exact truth: every kind of sensor, both kinds of threading.
#include <gtest/gtest.h>

#include <atomic>
#include <filesystem>
#include <fstream>
#include <map>
#include <sstream>
#include <thread>

#include "fastloop/io/run_output.hpp"
#include "simulated_run.hpp"

namespace fastloop::tests {
namespace fs = std::filesystem;
namespace {

using sim::CameraKind;
using system::Mode;
using system::System;

/// Files of a folder with their bytes.
std::map<std::string, std::string> contents(const fs::path& folder) {
  std::map<std::string, std::string> all;
  for (const auto& entry : fs::directory_iterator(folder)) {
    std::ostringstream text;
    text << std::ifstream(entry.path(), std::ios::binary).rdbuf();
    all[entry.path().filename().string()] = text.str();
  }
  return all;
}

fs::path fresh_folder(const std::string& name) {
  const fs::path folder = fs::path(::testing::TempDir()) / ("fastloop_end_to_end_" + name);
  fs::remove_all(folder);
  return folder;
}

/// Runs a recording and returns the bytes of every output that should not depend on the clock.
std::map<std::string, std::string> outputs_of_run(const Recording& recording, const std::string& name,
                                                  bool deterministic = true) {
  auto options = small_options();
  options.deterministic = deterministic;
  System system(recording.sequence.calibration(), options);
  feed(system, recording);
  const fs::path folder = fresh_folder(name);
  io::prepare_output_folder(folder);
  io::RunFacts facts;
  facts.dataset = "room";
  facts.T_body_cam0 = recording.sequence.calibration().cameras[0].T_body_camera;
  io::write_run_output(folder, system, facts);
  auto files = contents(folder);
  EXPECT_EQ(files.erase("timing.json"), 1u);
  fs::remove_all(folder);
  return files;
}

TEST(EndToEnd, StereoTracksEveryFrame) {
  const Recording recording(CameraKind::kPinhole, 10);
  System system(recording.sequence.calibration(), small_options(Mode::kStereo));
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_EQ(count_events(system, "initialised"), 1u);
  EXPECT_EQ(system.snapshot()->maps().size(), 1u);
  EXPECT_FALSE(system.imu_initialized());
  EXPECT_LT(ate_m(system, recording.sequence), 0.05);
}

TEST(EndToEnd, StereoInertialFindsGravityAndScale) {
  const Recording recording(CameraKind::kPinhole, 18);
  System system(recording.sequence.calibration(), small_options(Mode::kStereoInertial));
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  ASSERT_TRUE(system.imu_initialized());
  EXPECT_EQ(count_events(system, "imu_initialised"), 1u);
  EXPECT_LT(ate_m(system, recording.sequence), 0.05);
  EXPECT_LT(gravity_error_deg(system, recording.sequence, recording.frames.size() - 1), 0.5);
}

TEST(EndToEnd, FisheyeInertialTracksEveryFrame) {
  const Recording recording(CameraKind::kFisheye, 12);
  System system(recording.sequence.calibration(), small_options());
  ASSERT_EQ(system.mode(), Mode::kStereoInertial);
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_TRUE(system.imu_initialized());
  EXPECT_LT(ate_m(system, recording.sequence), 0.05);
}

TEST(EndToEnd, RgbdTracksEveryFrame) {
  const Recording recording(CameraKind::kRgbd, 10);
  System system(recording.sequence.calibration(), small_options());
  ASSERT_EQ(system.mode(), Mode::kRgbd);
  feed(system, recording);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_LT(ate_m(system, recording.sequence), 0.05);
}

TEST(EndToEnd, DeterministicRunsWriteTheSameBytes) {
  const Recording recording(CameraKind::kPinhole, 8);
  const auto first = outputs_of_run(recording, "first"), second = outputs_of_run(recording, "second");
  ASSERT_EQ(first.size(), 8u);
  EXPECT_GT(first.at("trajectory_body.txt").size(), 5000u);
  EXPECT_GT(first.at("map.ply").size(), 5000u);
  for (const auto& [name, bytes] : first) EXPECT_TRUE(bytes == second.at(name)) << name << " differs";
}

TEST(EndToEnd, ThreadsWriteTheSameBytesAsOneThread) {
  const Recording recording(CameraKind::kPinhole, 12);
  const auto one = outputs_of_run(recording, "one_thread");
  for (const std::string name : {"threads_first", "threads_second"}) {
    const auto threads = outputs_of_run(recording, name, false);
    ASSERT_EQ(one.size(), threads.size());
    for (const auto& [file, bytes] : one) EXPECT_TRUE(bytes == threads.at(file)) << file << " differs, " << name;
  }
}

TEST(EndToEnd, SnapshotsCanBeReadWhileThreadsRun) {
  const Recording recording(CameraKind::kPinhole, 8);
  auto options = small_options(Mode::kStereoInertial);
  options.deterministic = false;
  System system(recording.sequence.calibration(), options);
  std::atomic<bool> stop{false};
  std::size_t reads = 0;
  bool consistent = true;
  // The reader walks through everything a viewer would: versions never go back, every id resolves.
  std::thread reader([&] {
    std::uint64_t version = 0;
    while (!stop) {
      const auto map = system.snapshot();
      consistent &= map->version() >= version;
      version = map->version();
      for (std::uint32_t i = 0; i < map->landmark_slots(); ++i)
        if (map->contains(LandmarkId(i))) consistent &= map->p_world(LandmarkId(i)).allFinite();
      for (std::uint32_t i = 0; i < map->keyframe_slots(); ++i)
        for (const auto& edge : map->covisible(KeyframeId(i))) consistent &= edge.keyframe.value() < map->keyframe_slots();
      consistent &= system.events().size() < 1000;
      ++reads;
      std::this_thread::yield();
    }
  });
  feed(system, recording);
  stop = true;
  reader.join();
  EXPECT_TRUE(consistent);
  EXPECT_GT(reads, 1u);
  EXPECT_EQ(count_tracked(system), recording.frames.size());
  EXPECT_LT(ate_m(system, recording.sequence), 0.05);
}

}  // namespace
}  // namespace fastloop::tests
