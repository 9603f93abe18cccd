// Reads recorded sequences from the folder FASTLOOP_DATA; skipped where it is absent.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>

#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/dataset.hpp"
#include "fastloop/io/test_support.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

fs::path data_folder(const char* name) {
  const char* variable = std::getenv("FASTLOOP_DATA");
  return fs::path(variable ? variable : FASTLOOP_DEFAULT_DATA) / name;
}

double mean(const ImageU8& image) {
  double sum = 0;
  for (const auto v : image.pixels) sum += v;
  return sum / static_cast<double>(image.pixels.size());
}

/// Samples reach from at or before the previous stamp to at or after this one, without holes.
void expect_covering(const FrameInput& frame, Nanoseconds previous) {
  ASSERT_GE(frame.imu.size(), 2u);
  EXPECT_LE(frame.imu.front().stamp_ns, previous);
  EXPECT_GT(frame.imu[1].stamp_ns, previous);
  EXPECT_GE(frame.imu.back().stamp_ns, frame.stamp_ns);
  EXPECT_LT(frame.imu[frame.imu.size() - 2].stamp_ns, frame.stamp_ns);
}

TEST(RealData, EurocV101) {
  const fs::path folder = data_folder("euroc_v101_sparse");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const auto dataset = open_dataset(folder);
  EXPECT_EQ(dataset->format(), "euroc");
  EXPECT_THAT(dataset->remarks(), testing::IsEmpty());
  ASSERT_EQ(dataset->size(), 100u);
  EXPECT_EQ(dataset->stamp_ns(0), 1403715273262142976);
  const Calibration& c = dataset->calibration();
  const SE3 T_left_right = c.cameras[0].T_body_camera.inverse() * c.cameras[1].T_body_camera;
  EXPECT_NEAR(T_left_right.translation.norm(), 0.11007, 1e-4);
  EXPECT_DOUBLE_EQ(c.imu->gyro_noise_density, 1.6968e-4);
  EXPECT_EQ(c.cameras[0].rate_hz, 20);
  for (std::size_t i = 0; i < 3; ++i) {
    const FrameInput frame = dataset->load(i);
    EXPECT_EQ(frame.left.width, 752);
    EXPECT_EQ(frame.right.height, 480);
    EXPECT_GT(mean(frame.left), 20);
    EXPECT_LT(mean(frame.left), 230);
    if (i > 0) expect_covering(frame, dataset->stamp_ns(i - 1));
  }
  ASSERT_TRUE(dataset->ground_truth());
  EXPECT_EQ(dataset->ground_truth()->filename(), "V1_01_easy_openvins_corrected_tum.txt");
}

TEST(RealData, TumViRoom1) {
  const fs::path folder = data_folder("tumvi_room1_3s");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const auto dataset = open_dataset(folder);
  EXPECT_EQ(dataset->format(), "tum-vi");
  EXPECT_THAT(dataset->remarks(), testing::IsEmpty());
  ASSERT_EQ(dataset->size(), 60u);
  const Calibration& c = dataset->calibration();
  EXPECT_EQ(c.cameras[0].camera.model, CameraModel::kKannalaBrandt);
  const SE3 T_left_right = c.cameras[0].T_body_camera.inverse() * c.cameras[1].T_body_camera;
  EXPECT_NEAR(T_left_right.translation.norm(), 0.1011, 3e-4);
  EXPECT_NEAR(c.cameras[0].rate_hz, 20, 0.1);
  EXPECT_DOUBLE_EQ(c.imu->accel_noise_density, 0.0028);  // from imu_config.yaml
  // At rest in this piece, gravity is all the accelerometer feels, up to the motion of a hand.
  Vector3d sum = Vector3d::Zero();
  for (std::size_t i = 1; i < dataset->size(); ++i) {
    const FrameInput frame = dataset->load(i);
    expect_covering(frame, dataset->stamp_ns(i - 1));
    sum += frame.imu.front().accel;
  }
  EXPECT_NEAR((sum / 59).norm(), 9.8, 0.5);
  EXPECT_EQ(dataset->ground_truth()->parent_path().filename(), "mocap0");
}

TEST(RealData, RedkitchenRgbd) {
  const fs::path folder = data_folder("redkitchen_rgbd");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const auto assumed = open_dataset(folder);
  EXPECT_THAT(assumed->remarks(), testing::Contains(testing::HasSubstr("fx = fy = 585")));

  const TemporaryFolder temporary;
  Calibration true_values = assumed->calibration();
  true_values.cameras[0].camera.fx = true_values.cameras[0].camera.fy = 585;
  true_values.depth->units_per_metre = 1000;
  save_calibration(temporary.path() / "kitchen.yaml", true_values);
  const auto dataset = open_dataset(folder, {temporary.path() / "kitchen.yaml"});
  EXPECT_EQ(dataset->format(), "tum-rgbd");
  EXPECT_THAT(dataset->remarks(), testing::IsEmpty());
  ASSERT_EQ(dataset->size(), 1000u);
  const FrameInput frame = dataset->load(500);
  EXPECT_TRUE(frame.right.empty());
  std::vector<float> known;
  for (const float z : frame.depth.pixels)
    if (z > 0) known.push_back(z);
  ASSERT_GT(known.size(), frame.depth.pixels.size() / 2);
  std::nth_element(known.begin(), known.begin() + static_cast<std::ptrdiff_t>(known.size() / 2),
                   known.end());
  EXPECT_GT(known[known.size() / 2], 0.5F);  // a kitchen: one to four metres
  EXPECT_LT(known[known.size() / 2], 5.0F);
  EXPECT_LT(*std::max_element(known.begin(), known.end()), 60.0F);
  EXPECT_EQ(dataset->ground_truth()->filename(), "groundtruth.txt");
}

}  // namespace
}  // namespace fastloop::io
