#include "fastloop/io/calibration_yaml.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>

#include "fastloop/core/error.hpp"
#include "fastloop/io/test_support.hpp"

namespace fastloop::io {
namespace {

const std::string kGood = R"(cameras:
  - model: pinhole-radtan
    resolution: [752, 480]
    intrinsics: [458.654, 457.296, 367.215, 248.375]
    distortion: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
    rate_hz: 20
  - model: pinhole-radtan
    resolution: [752, 480]
    intrinsics: [457.587, 456.134, 379.999, 255.238]
    distortion: [-0.28368365, 0.07451284, -0.00010473, -3.555907e-05]
T_body_cam0: [0, -1, 0, -0.02, 1, 0, 0, -0.06, 0, 0, 1, 0.01, 0, 0, 0, 1]
T_body_cam1: [0, -1, 0, -0.02, 1, 0, 0, 0.05, 0, 0, 1, 0.01, 0, 0, 0, 1]
imu:
  gyro_noise_density: 1.7e-4
  gyro_random_walk: 2e-5
  accel_noise_density: 2e-3
  accel_random_walk: 3e-3
  time_shift_s: -0.004
)";

std::string with(const std::string& from, const std::string& to) {
  std::string text = kGood;
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  return text.replace(at, from.size(), to);
}

std::string rejection(const std::string& text) {
  return input_error([&] { parse_calibration(text, "rig.yaml"); });
}

TEST(CalibrationYaml, ReadsEveryValue) {
  const Calibration c = parse_calibration(kGood, "rig.yaml");
  ASSERT_EQ(c.cameras.size(), 2u);
  EXPECT_EQ(c.cameras[0].camera.width, 752);
  EXPECT_EQ(c.cameras[0].camera.height, 480);
  EXPECT_DOUBLE_EQ(c.cameras[1].camera.cx, 379.999);
  EXPECT_DOUBLE_EQ(c.cameras[0].camera.distortion[3], 1.76187114e-05);
  EXPECT_NEAR(c.cameras[1].T_body_camera.translation.y(), 0.05, 1e-15);
  EXPECT_LT((c.cameras[0].T_body_camera * Vector3d(1, 0, 0) - Vector3d(-0.02, 0.94, 0.01)).norm(),
            1e-12);
  ASSERT_TRUE(c.imu);
  EXPECT_DOUBLE_EQ(c.imu->time_shift_s, -0.004);
  EXPECT_DOUBLE_EQ(c.imu->accel_noise_density, 2e-3);
  EXPECT_FALSE(c.depth);
}

TEST(CalibrationYaml, WrittenFileReadsBackTheSame) {
  const TemporaryFolder folder;
  Calibration c = parse_calibration(kGood, "rig.yaml");
  c.cameras[0].T_body_camera =
      c.cameras[0].T_body_camera.retract((Vector6d() << 0.3, -0.2, 1, 4, 5, 6).finished());
  c.cameras[1].camera.model = CameraModel::kKannalaBrandt;
  c.cameras[0].camera.distortion[4] = 0.1 / 3;
  save_calibration(folder.path() / "rig.yaml", c);
  const Calibration d = load_calibration(folder.path() / "rig.yaml");
  for (int i = 0; i < 2; ++i) {
    EXPECT_EQ(d.cameras[i].camera.model, c.cameras[i].camera.model);
    EXPECT_EQ(d.cameras[i].camera.distortion, c.cameras[i].camera.distortion);
    EXPECT_EQ(d.cameras[i].camera.fx, c.cameras[i].camera.fx);
    EXPECT_LT(d.cameras[i].T_body_camera.local(c.cameras[i].T_body_camera).norm(), 1e-14);
  }
  EXPECT_EQ(d.imu->time_shift_s, c.imu->time_shift_s);
  EXPECT_EQ(d.imu->gyro_random_walk, c.imu->gyro_random_walk);
}

TEST(CalibrationYaml, DepthCameraNeedsNoPose) {
  const std::string text =
      "cameras:\n  - {model: pinhole-radtan, resolution: [640, 480], intrinsics: [585, 585, 320, "
      "240], "
      "distortion: [0, 0, 0, 0]}\ndepth:\n  units_per_metre: 1000\n";
  const Calibration c = parse_calibration(text, "rgbd.yaml");
  ASSERT_TRUE(c.depth);
  EXPECT_EQ(c.depth->units_per_metre, 1000);
  EXPECT_EQ(c.cameras[0].T_body_camera.translation.norm(), 0);
}

TEST(CalibrationYaml, EveryComplaintNamesFileLineAndKey) {
  struct Case {
    std::string text;
    std::vector<std::string> parts;
  };
  const std::vector<Case> cases = {
      {with("    rate_hz: 20\n", "    rate_hs: 20\n"),
       {"rig.yaml:6:", "cameras[0].rate_hs", "unknown key", "rate_hz"}},
      {with("imu:\n", "imus:\n"), {"rig.yaml:13:", "imus", "unknown key", "depth"}},
      {with("  gyro_random_walk: 2e-5\n", ""),
       {"rig.yaml:13:", "imu.gyro_random_walk", "missing", "rad / s^2"}},
      {with("time_shift_s: -0.004", "time_shift_s: .nan"),
       {"rig.yaml:18:", "imu.time_shift_s", "not finite"}},
      {with("457.296", "inf"), {"rig.yaml:4:", "cameras[0].intrinsics[1]", "not finite"}},
      {with("457.296", "4S7"),
       {"rig.yaml:4:", "cameras[0].intrinsics[1]", "'4S7' is not a number"}},
      {with("[458.654, 457.296,", "[458.654, -457.296,"),
       {"rig.yaml:4:", "cameras[0].intrinsics", "> 0"}},
      {with(", 248.375", ""), {"rig.yaml:4:", "cameras[0].intrinsics", "3 numbers", "4 numbers"}},
      {with("[752, 480]", "[752, 0]"), {"rig.yaml:3:", "cameras[0].resolution", "> 0"}},
      {with("[752, 480]", "[752.5, 480]"),
       {"rig.yaml:3:", "cameras[0].resolution[0]", "whole number"}},
      {with("    resolution: [752, 480]\n", ""),
       {"rig.yaml:2:", "cameras[0].resolution", "missing", "pixels"}},
      {with("pinhole-radtan", "omni"),
       {"rig.yaml:2:", "cameras[0].model", "'omni'", "kannala-brandt"}},
      {with("T_body_cam0: [0, -1", "T_body_cam0: [0, -1.1"),
       {"rig.yaml:11:", "T_body_cam0", "orthonormal"}},
      {with("T_body_cam0: [0, -1", "T_body_cam0: [0, 1"),
       {"rig.yaml:11:", "T_body_cam0", "orthonormal"}},
      {with("0.05, 0, 0, 1, 0.01, 0, 0, 0, 1]", "0.05, 0, 0, 1, 0.01, 0, 0, 0, 2]"),
       {"rig.yaml:12:", "T_body_cam1", "last row"}},
      {with("0.05, 0, 0, 1, 0.01, 0, 0, 0, 1]", "0.05, 0, 0, 1, 0.01, 0, 0, 0]"),
       {"rig.yaml:12:", "T_body_cam1", "15 numbers", "16"}},
      {with("-0.02, 1, 0, 0, 0.05", "-0.02, 1, 0, 0, -0.06"),
       {"rig.yaml", "cam1.T_body_camera", "1 mm"}},
      {with("T_body_cam1:", "T_body_cam0:"), {"rig.yaml:12:", "T_body_cam0", "twice"}},
      {with("T_body_cam1:", "#"), {"rig.yaml", "T_body_cam1", "missing"}},
      {with("gyro_noise_density: 1.7e-4", "gyro_noise_density: 0"),
       {"rig.yaml:14:", "imu.gyro_noise_density", "> 0"}},
      {with("    resolution", "   resolution"), {"rig.yaml:3:", "not valid YAML"}},
      {"", {"rig.yaml", "no keys"}},
      {"- 1\n", {"rig.yaml", "no keys"}},
      {"cameras: 3\n", {"rig.yaml:1:", "cameras", "not a list"}},
      {"cameras: []\n", {"rig.yaml:1:", "cameras", "0 cameras"}},
  };
  for (const Case& c : cases) {
    const std::string message = rejection(c.text);
    for (const std::string& part : c.parts)
      EXPECT_THAT(message, testing::HasSubstr(part)) << c.text;
  }
}

TEST(CalibrationYaml, ReportsFilesItCannotReadOrWrite) {
  const TemporaryFolder folder;
  EXPECT_THAT(
      input_error([&] { load_calibration(folder.path() / "none.yaml"); }),
      testing::AllOf(testing::HasSubstr("none.yaml"), testing::HasSubstr("cannot be opened")));
  EXPECT_THAT(input_error([&] { load_calibration(folder.path()); }),
              testing::HasSubstr("is a folder"));
  const Calibration c = parse_calibration(kGood, "rig.yaml");
  EXPECT_THAT(input_error([&] { save_calibration(folder.path() / "none" / "rig.yaml", c); }),
              testing::HasSubstr("cannot be written"));
  if (std::filesystem::exists("/dev/full")) {
    EXPECT_THAT(input_error([&] { save_calibration("/dev/full", c); }),
                testing::HasSubstr("disk space"));
  }
}

}  // namespace
}  // namespace fastloop::io
