#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/dataset.hpp"
#include "fastloop/io/test_support.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;
using testing::AllOf;
using testing::Contains;
using testing::HasSubstr;
using testing::IsEmpty;

std::string open_error(const fs::path& folder) {
  return input_error([&] { open_dataset(folder); });
}

constexpr const char* kRgbdCalibration =
    "cameras:\n  - {model: pinhole-radtan, resolution: [32, 24], intrinsics: [30, 30, 15.5, 11.5], "
    "distortion: [0, 0, 0, 0], rate_hz: 30}\ndepth:\n  units_per_metre: 1000\n";

/// Three colour images at 10 Hz; each depth image is 10 ms late and holds its number in metres.
void make_tum(const TemporaryFolder& folder, const std::string& calibration = kRgbdCalibration) {
  std::string rgb = "# color images\n# timestamp filename\n", depth = "# depth maps\n";
  for (int i = 0; i < 3; ++i) {
    const std::string c = "rgb/" + std::to_string(i) + ".png",
                      d = "depth/" + std::to_string(i) + ".png";
    rgb += "1305031102." + std::to_string(i) + " " + c + "\n";
    depth += "1305031102." + std::to_string(i) + "1 " + d + "\n";
    write_colour_image(folder.path() / c, 32, 24, 10 * i, 20, 30);
    Image<std::uint16_t> z(32, 24);
    std::fill(z.pixels.begin(), z.pixels.end(), static_cast<std::uint16_t>(1000 * i + 500));
    write_image(folder.path() / d, z);
  }
  folder.write("rgb.txt", rgb);
  folder.write("depth.txt", depth);
  if (!calibration.empty()) folder.write("calibration.yaml", calibration);
}

TEST(TumRgbdReader, PairsColourAndDepth) {
  const TemporaryFolder folder;
  make_tum(folder);
  folder.write("groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n");
  const auto dataset = open_dataset(folder.path());
  EXPECT_EQ(dataset->format(), "tum-rgbd");
  EXPECT_THAT(dataset->remarks(), IsEmpty());
  ASSERT_EQ(dataset->size(), 3u);
  EXPECT_EQ(dataset->stamp_ns(1), 1305031102100000000);
  const FrameInput frame = dataset->load(2);
  EXPECT_NEAR(frame.left.at(3, 3), 0.299 * 20 + 0.587 * 20 + 0.114 * 30, 1.01);
  EXPECT_FLOAT_EQ(frame.depth.at(3, 3), 2.5F);
  EXPECT_TRUE(frame.right.empty());
  EXPECT_THAT(frame.imu, IsEmpty());
  EXPECT_EQ(dataset->ground_truth(), folder.path() / "groundtruth.txt");
}

TEST(TumRgbdReader, ReportsFramesWithoutDepth) {
  const TemporaryFolder folder;
  make_tum(folder);
  folder.write("depth.txt",
               "1305031102.01 depth/0.png\n1305031102.21 depth/2.png\n1305031102.24 depth/1.png\n");
  const auto dataset = open_dataset(folder.path());
  EXPECT_EQ(dataset->size(), 2u);
  EXPECT_THAT(dataset->remarks(), Contains("rgb.txt: 1 image(s) without partner dropped"));
  EXPECT_THAT(dataset->remarks(), Contains("depth.txt: 1 image(s) without partner dropped"));
}

TEST(TumRgbdReader, AssociationsAreFollowedInEitherOrder) {
  const TemporaryFolder folder;
  make_tum(folder);
  folder.write("associations.txt",
               "0.5 rgb/1.png 0.5 depth/0.png\n0.1 rgb/0.png 0.1 depth/2.png\n");
  EXPECT_FLOAT_EQ(open_dataset(folder.path())->load(1).depth.at(0, 0), 0.5F);
  EXPECT_THAT(open_dataset(folder.path())->remarks(),
              Contains("associations.txt: 1 unordered row(s) sorted"));
  folder.write("associations.txt", "0.1 depth/2.png 0.2 rgb/0.png\n");
  const auto dataset = open_dataset(folder.path());
  EXPECT_EQ(dataset->stamp_ns(0), 200000000);
  EXPECT_FLOAT_EQ(dataset->load(0).depth.at(0, 0), 2.5F);
}

TEST(TumRgbdReader, MissingFramesAreDropped) {
  const TemporaryFolder folder;
  make_tum(folder);
  fs::remove(folder.path() / "depth" / "1.png");
  const auto dataset = open_dataset(folder.path());
  EXPECT_EQ(dataset->size(), 2u);
  EXPECT_THAT(dataset->remarks(), Contains("1 listed frame(s) do not exist, dropped"));
}

TEST(TumRgbdReader, BadInputNamesFileAndExpectation) {
  const TemporaryFolder folder;
  make_tum(folder, "");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("calibration.yaml"), HasSubstr("--calib")));
  make_tum(folder);
  folder.write("rgb.txt", "# x\n1305031102.0 rgb/0.png\nrgb/1.png\n");
  EXPECT_THAT(open_error(folder.path()), AllOf(HasSubstr("rgb.txt:3:"), HasSubstr("seconds")));
  make_tum(folder);
  folder.write("depth.txt", "# nothing\n");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("depth.txt"), HasSubstr("lists no images")));
  fs::remove(folder.path() / "depth.txt");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("depth.txt"), HasSubstr("cannot be opened")));
  make_tum(folder);
  folder.write("depth.txt", "7.0 depth/0.png\n");
  EXPECT_THAT(open_error(folder.path()), HasSubstr("within 20 ms"));
  make_tum(folder);
  write_image(folder.path() / "depth/0.png", pattern(32, 24, 0));
  EXPECT_THAT(open_error(folder.path()), AllOf(HasSubstr("depth/0.png"), HasSubstr("16-bit")));
  make_tum(folder);
  write_colour_image(folder.path() / "rgb/0.png", 30, 24, 1, 1, 1);
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("rgb/0.png"), HasSubstr("30x24"), HasSubstr("32x24")));
}

TEST(TumRgbdReader, StereoCalibrationDoesNotFit) {
  const TemporaryFolder folder;
  make_tum(folder, "");
  Calibration c;
  c.cameras.resize(2);
  for (auto& camera : c.cameras)
    camera.camera = {CameraModel::kPinhole, 32, 24, 30, 30, 15, 11, {}};
  c.cameras[1].T_body_camera.translation.x() = 0.1;
  save_calibration(folder.path() / "calibration.yaml", c);
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("calibration.yaml"), HasSubstr("depth"), HasSubstr("stereo")));
}

void make_kitti(const TemporaryFolder& folder, int left = 0) {
  std::string times;
  for (int i = 0; i < 3; ++i) {
    char name[32];
    std::snprintf(name, sizeof name, "%06d.png", i);
    write_image(folder.path() / ("image_" + std::to_string(left)) / name, pattern(48, 16, i));
    write_image(folder.path() / ("image_" + std::to_string(left + 1)) / name,
                pattern(48, 16, i + 10));
    std::snprintf(name, sizeof name, "%e\n", 0.1 * i);
    times += name;
  }
  folder.write("times.txt", times);
  folder.write("calib.txt",
               "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n"
               "P2: 700 0 600 42 0 700 180 0 0 0 1 0\nP3: 700 0 600 -336 0 700 180 0 0 0 1 0\nTr: "
               "1 0 0 0 0 1 0 0 0 0 1 0\n");
}

TEST(KittiReader, ReadsGreyAndColourCameras) {
  for (const int left : {0, 2}) {
    const TemporaryFolder folder;
    make_kitti(folder, left);
    const auto dataset = open_dataset(folder.path());
    EXPECT_EQ(dataset->format(), "kitti");
    ASSERT_EQ(dataset->size(), 3u);
    EXPECT_EQ(dataset->stamp_ns(2), 200000000);
    const Calibration& c = dataset->calibration();
    EXPECT_TRUE(c.cameras[0].camera.is_ideal_pinhole());
    EXPECT_NEAR(c.cameras[1].T_body_camera.translation.x(), 0.54, 1e-9);
    EXPECT_NEAR(c.cameras[0].rate_hz, 10, 1e-9);
    EXPECT_FALSE(c.imu);
    EXPECT_EQ(dataset->load(1).right.pixels, pattern(48, 16, 11).pixels);
  }
}

TEST(KittiReader, CountsThatDisagreeAreReported) {
  const TemporaryFolder folder;
  make_kitti(folder);
  fs::remove(folder.path() / "image_1" / "000001.png");
  folder.write("times.txt", "0\r\n0.1\r\n0.2\r\n0.3\r\n");
  const auto dataset = open_dataset(folder.path());
  EXPECT_EQ(dataset->size(), 2u);
  EXPECT_THAT(dataset->remarks(), Contains("2 frame(s) of times.txt without both images dropped"));
}

TEST(KittiReader, BadInputNamesFileLineAndKey) {
  const TemporaryFolder folder;
  make_kitti(folder);
  folder.write("times.txt", "0\nlater\n");
  EXPECT_THAT(open_error(folder.path()), AllOf(HasSubstr("times.txt:2:"), HasSubstr("seconds")));
  make_kitti(folder);
  folder.write("calib.txt",
               "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1\n");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("calib.txt:2:"), HasSubstr("P1"), HasSubstr("11 numbers")));
  folder.write("calib.txt", "P0: 700 0 600 0 0 nan 180 0 0 0 1 0\n");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("calib.txt:1:"), HasSubstr("P0"), HasSubstr("'nan'")));
  folder.write("calib.txt", "P0: 700 0 600 0 0 700 180 0 0 0 1 0\n");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("calib.txt"), HasSubstr("P1"), HasSubstr("missing")));
  folder.write("calib.txt",
               "P0: 0 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n");
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("calib.txt:1:"), HasSubstr("P0"), HasSubstr("fx, fy > 0")));
}

TEST(OpenDataset, FoldersThatAreNoDataSet) {
  const TemporaryFolder folder;
  EXPECT_THAT(open_error(folder.path() / "none"),
              AllOf(HasSubstr("none"), HasSubstr("does not exist")));
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("is empty"), HasSubstr("EuRoC"), HasSubstr("KITTI")));
  EXPECT_THAT(open_error(folder.write("a.txt", "x")),
              AllOf(HasSubstr("a.txt"), HasSubstr("is a file")));
  EXPECT_THAT(open_error(folder.path()),
              AllOf(HasSubstr("none of the known layouts"), HasSubstr("rgb.txt")));
  const EurocFolder euroc(folder);
  EXPECT_THAT(open_error(folder.path()), HasSubstr("did you mean " + euroc.root.string()));
}

}  // namespace
}  // namespace fastloop::io
