#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <thread>

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

TEST(EurocReader, ReadsImagesCalibrationAndImu) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  for (const fs::path& folder : {euroc.root, euroc.mav()}) {
    const auto dataset = open_dataset(folder);
    EXPECT_EQ(dataset->format(), "euroc");
    EXPECT_THAT(dataset->remarks(), IsEmpty());
    EXPECT_FALSE(dataset->ground_truth());
    ASSERT_EQ(dataset->size(), 5u);
    for (std::size_t i = 0; i < 5; ++i) {
      const FrameInput frame = dataset->load(i);
      const int n = static_cast<int>(i);
      EXPECT_EQ(frame.stamp_ns, EurocFolder::stamp(n));
      EXPECT_EQ(frame.left.pixels, pattern(40, 30, 2 * n).pixels);
      EXPECT_EQ(frame.right.pixels, pattern(40, 30, 2 * n + 1).pixels);
      EXPECT_TRUE(frame.depth.empty());
      ASSERT_EQ(frame.imu.size(), i == 0 ? 2u : 12u);
      EXPECT_EQ(frame.imu.front().stamp_ns, EurocFolder::stamp(i == 0 ? 0 : n - 1) - 3'000'000);
      EXPECT_EQ(frame.imu.back().stamp_ns, frame.stamp_ns + 2'000'000);
    }
    EXPECT_EQ(dataset->imu_between(EurocFolder::stamp(1), EurocFolder::stamp(3)).size(), 22u);
    EXPECT_THROW(dataset->load(5), InvalidArgument);
  }
}

TEST(EurocReader, FindsGroundTruth) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  temporary.write("sequence/mav0/state_groundtruth_estimate0/data.csv", "#\n");
  EXPECT_EQ(open_dataset(euroc.root)->ground_truth(),
            euroc.mav() / "state_groundtruth_estimate0" / "data.csv");
}

TEST(EurocReader, TheBodyIsTheImuWhereverEurocPutsIt) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  euroc.edit("imu0/sensor.yaml", "data: [1, 0, 0, 0,", "data: [1, 0, 0, 0.5,");
  const auto dataset = open_dataset(euroc.root);
  EXPECT_NEAR(dataset->calibration().cameras[0].T_body_camera.translation.x(), -0.5, 1e-12);
  EXPECT_NEAR(dataset->calibration().cameras[1].T_body_camera.translation.x(), 0.11 - 0.5, 1e-12);
}

TEST(EurocReader, WithoutImuTheBodyIsTheLeftCamera) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  fs::remove_all(euroc.mav() / "imu0");
  const auto dataset = open_dataset(euroc.root);
  EXPECT_FALSE(dataset->calibration().imu);
  EXPECT_LT(dataset->calibration().cameras[0].T_body_camera.translation.norm(), 1e-15);
  EXPECT_NEAR(dataset->calibration().cameras[1].T_body_camera.translation.x(), 0.11, 1e-12);
  EXPECT_THAT(dataset->remarks(), Contains(HasSubstr("body frame is that of cam0")));
  EXPECT_THAT(dataset->remarks(), Contains(HasSubstr("there is no IMU")));
  EXPECT_THAT(dataset->load(2).imu, IsEmpty());
}

TEST(EurocReader, FisheyeSensorYaml) {
  for (const char* model : {"equidistant", "kannala-brandt", "kb4"}) {
    const TemporaryFolder temporary;
    const EurocFolder euroc(temporary);
    for (const char* camera : {"cam0", "cam1"})
      euroc.edit(std::string(camera) + "/sensor.yaml", "radial-tangential", model);
    const Camera camera = open_dataset(euroc.root)->calibration().cameras[1].camera;
    EXPECT_EQ(camera.model, CameraModel::kKannalaBrandt);
    EXPECT_EQ(camera.distortion[1], 0.02);
  }
}

TEST(EurocReader, PairsByTimeAndReportsWhatWasDropped) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary, 6);
  const std::string line1 = std::to_string(EurocFolder::stamp(1));
  const std::string line4 = std::to_string(EurocFolder::stamp(4));
  euroc.edit("cam0/data.csv", line1 + "," + line1 + ".png\n", "");
  // 3 ms later is the same frame, 20 ms later is not.
  euroc.edit("cam1/data.csv", line4 + ",", std::to_string(EurocFolder::stamp(4) + 3'000'000) + ",");
  euroc.edit("cam1/data.csv", std::to_string(EurocFolder::stamp(2)) + ",",
             std::to_string(EurocFolder::stamp(2) + 20'000'000) + ",");
  const auto dataset = open_dataset(euroc.root);
  ASSERT_EQ(dataset->size(), 4u);
  EXPECT_EQ(dataset->stamp_ns(1), EurocFolder::stamp(3));
  EXPECT_EQ(dataset->stamp_ns(2), EurocFolder::stamp(4));
  EXPECT_EQ(dataset->load(2).right.pixels, pattern(40, 30, 9).pixels);
  EXPECT_THAT(dataset->remarks(), Contains("cam0: 1 image(s) without partner dropped"));
  EXPECT_THAT(dataset->remarks(), Contains("cam1: 2 image(s) without partner dropped"));
}

TEST(EurocReader, ListedImagesThatDoNotExistAreDropped) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  fs::remove(euroc.image(1, 3));
  const auto dataset = open_dataset(euroc.root);
  EXPECT_EQ(dataset->size(), 4u);
  EXPECT_THAT(dataset->remarks(), Contains("cam1: 1 listed image(s) do not exist, dropped"));
  EXPECT_THAT(dataset->remarks(), Contains("cam0: 1 image(s) without partner dropped"));
}

TEST(EurocReader, ToleratesAndRepairsImageLists) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary, 3);
  const auto name = [](int i) { return std::to_string(EurocFolder::stamp(i)); };
  temporary.write("sequence/mav0/cam0/data.csv",
                  "timestamp [ns],filename\r\n\r\n" + name(2) + " , " + name(2) + ".png \r\n" +
                      name(0) + "," + name(0) + ".png\r\n# x\r\n" + name(1) + "," + name(1) +
                      ".png\r\n" + name(1) + "," + name(1) + ".png\r\n");
  const auto dataset = open_dataset(euroc.root);
  ASSERT_EQ(dataset->size(), 3u);
  EXPECT_EQ(dataset->load(1).left.pixels, pattern(40, 30, 2).pixels);
  EXPECT_THAT(dataset->remarks(),
              Contains("cam0/data.csv: 1 unordered row(s) sorted, 1 duplicate stamp(s) removed"));
}

TEST(EurocReader, FallsBackToTheStampsInFileNames) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  fs::remove(euroc.mav() / "cam1" / "data.csv");
  const auto dataset = open_dataset(euroc.root);
  EXPECT_EQ(dataset->size(), 5u);
  EXPECT_THAT(dataset->remarks(),
              Contains(AllOf(HasSubstr("cam1: no data.csv"), HasSubstr("5 images"))));
}

TEST(EurocReader, FindsImagesThatWereConvertedToJpeg) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary, 2);
  for (int i = 0; i < 2; ++i)
    for (int camera = 0; camera < 2; ++camera) {
      fs::path jpeg = euroc.image(camera, i);
      fs::remove(jpeg);
      write_image(jpeg.replace_extension(".jpg"), pattern(40, 30, i));
    }
  EXPECT_EQ(open_dataset(euroc.root)->load(1).left.width, 40);
}

TEST(EurocReader, RepairsTheImuWithRemarks) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  euroc.edit("imu0/data.csv", "0.1,0.2,0.3", "nan,0.2,0.3");
  const auto dataset = open_dataset(euroc.root);
  EXPECT_THAT(dataset->remarks(),
              Contains(AllOf(HasSubstr("imu0/data.csv"), HasSubstr("line 2"), HasSubstr("NaN"))));
}

TEST(EurocReader, SaysWhichFramesTheImuDoesNotCover) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  std::string csv = euroc.imu_csv();
  temporary.write("sequence/mav0/imu0/data.csv", csv.substr(0, csv.size() / 2));
  const std::string cut = open_error(euroc.root);  // the last line is cut in the middle
  EXPECT_THAT(cut, AllOf(HasSubstr("imu0/data.csv:"), HasSubstr("3 angular rates")));
  temporary.write("sequence/mav0/imu0/data.csv",
                  csv.substr(0, csv.rfind('\n', csv.size() / 2) + 1));
  EXPECT_THAT(open_dataset(euroc.root)->remarks(),
              Contains(HasSubstr("frame(s) after the last IMU sample")));
}

TEST(EurocReader, EmptyImuFileMeansNoImu) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  temporary.write("sequence/mav0/imu0/data.csv", "#timestamp\n");
  const auto dataset = open_dataset(euroc.root);
  EXPECT_FALSE(dataset->calibration().imu);
  EXPECT_THAT(dataset->remarks(), Contains(HasSubstr("no samples")));
}

TEST(EurocReader, GivenCalibrationReplacesTheOneInTheFolder) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  Calibration c = open_dataset(euroc.root)->calibration();
  c.cameras[0].camera.fx = 33;
  c.imu->time_shift_s = 0.002;
  save_calibration(temporary.path() / "own.yaml", c);
  const auto dataset = open_dataset(euroc.root, {temporary.path() / "own.yaml"});
  EXPECT_EQ(dataset->calibration().cameras[0].camera.fx, 33);
  // The samples lie 2 ms off the frames; with the shift taken out they coincide.
  EXPECT_EQ(dataset->load(1).imu.back().stamp_ns, EurocFolder::stamp(1));

  c.cameras.resize(1);
  c.depth.emplace();
  save_calibration(temporary.path() / "depth.yaml", c);
  EXPECT_THAT(input_error([&] { open_dataset(euroc.root, {temporary.path() / "depth.yaml"}); }),
              AllOf(HasSubstr("depth.yaml"), HasSubstr("one camera")));
}

TEST(EurocReader, TumViExportHasSixteenBitImagesAndACamchain) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary, 2);
  for (const char* sensor : {"cam0", "cam1", "imu0"})
    fs::remove(euroc.mav() / sensor / "sensor.yaml");
  temporary.write("sequence/mav0/mocap0/data.csv", "#\n");
  Image<std::uint16_t> image(40, 30);
  for (std::size_t i = 0; i < image.pixels.size(); ++i)
    image.pixels[i] = static_cast<std::uint16_t>(54 * i);
  for (int i = 0; i < 2; ++i)
    for (int camera = 0; camera < 2; ++camera) write_image(euroc.image(camera, i), image);
  EXPECT_THAT(open_error(euroc.root), AllOf(HasSubstr("there is no calibration"),
                                            HasSubstr("camchain"), HasSubstr("--calib")));

  const std::string camera =
      "  camera_model: pinhole\n  distortion_coeffs: [0.01, -0.01, 0.006, -0.002]\n  "
      "distortion_model: equidistant\n"
      "  intrinsics: [19.0, 19.0, 20, 15]\n  resolution: [40, 30]\n";
  temporary.write(
      "sequence/dso/camchain.yaml",
      "cam0:\n  T_cam_imu:\n  - [1, 0, 0, 0.02]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, "
      "1]\n" +
          camera +
          "  timeshift_cam_imu: 0.001\ncam1:\n  T_cn_cnm1:\n  - [1, 0, 0, -0.1]\n  - [0, 1, 0, 0]\n"
          "  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n" +
          camera);
  const auto dataset = open_dataset(euroc.root);
  EXPECT_EQ(dataset->format(), "tum-vi");
  const Calibration& c = dataset->calibration();
  EXPECT_NEAR(c.cameras[0].T_body_camera.translation.x(), -0.02, 1e-12);
  EXPECT_NEAR(c.cameras[1].T_body_camera.translation.x(), 0.08, 1e-12);
  EXPECT_EQ(c.imu->time_shift_s, 0.001);
  EXPECT_NEAR(c.cameras[0].rate_hz, 20, 1e-9) << "measured: Kalibr does not say";
  const FrameInput frame = dataset->load(1);
  EXPECT_EQ(frame.left.pixels[1000], 54 * 1000 / 256);
  EXPECT_EQ(frame.imu.back().stamp_ns, EurocFolder::stamp(1) + 1'000'000);
  EXPECT_EQ(dataset->ground_truth(), euroc.mav() / "mocap0" / "data.csv");
}

TEST(EurocReader, EveryBadInputNamesFileAndExpectation) {
  struct Case {
    std::string what;
    std::function<void(const EurocFolder&)> spoil;
    std::vector<std::string> parts;
  };
  const std::vector<Case> cases = {
      {"no right camera",
       [](const EurocFolder& e) { fs::remove_all(e.mav() / "cam1"); },
       {"mav0/cam1", "stereo pair"}},
      {"no image folder",
       [](const EurocFolder& e) { fs::remove_all(e.mav() / "cam0/data"); },
       {"cam0/data", "does not exist", "PNG or JPEG"}},
      {"no images",
       [](const EurocFolder& e) {
         fs::remove_all(e.mav() / "cam0/data");
         fs::create_directories(e.mav() / "cam0/data");
       },
       {"cam0/data", "holds no images"}},
      {"junk in the list",
       [](const EurocFolder& e) {
         e.edit("cam0/data.csv", std::to_string(EurocFolder::stamp(2)) + ",", "what? ");
       },
       {"cam0/data.csv:4:", "what? ", "nanoseconds"}},
      {"empty list",
       [](const EurocFolder& e) { write_text_file(e.mav() / "cam1/data.csv", "#\n"); },
       {"cam1/data.csv", "lists no images"}},
      {"cameras of different times",
       [](const EurocFolder& e) {
         std::string csv = e.image_csv();
         for (std::size_t at = 0; (at = csv.find("\n1403", at)) != std::string::npos; ++at)
           csv[at + 1] = '2';
         write_text_file(e.mav() / "cam1/data.csv", csv);
       },
       {"mav0", "no frame has all of its images"}},
      {"junk in the IMU",
       [](const EurocFolder& e) { e.edit("imu0/data.csv", ",0.1,", ",oops,"); },
       {"imu0/data.csv:2:", "oops", "3 angular rates"}},
      {"unknown distortion",
       [](const EurocFolder& e) { e.edit("cam1/sensor.yaml", "radial-tangential", "fov"); },
       {"cam1/sensor.yaml:14:", "distortion_model", "'fov'", "equidistant"}},
      {"missing intrinsics",
       [](const EurocFolder& e) { e.edit("cam0/sensor.yaml", "intrinsics", "intrinsic"); },
       {"cam0/sensor.yaml", "intrinsics", "missing"}},
      {"rotation",
       [](const EurocFolder& e) {
         e.edit("cam0/sensor.yaml", "0.0, 1.0, 0.0, 0.02", "0.0, 1.2, 0.0, 0.02");
       },
       {"cam0/sensor.yaml:6:", "T_BS.data", "orthonormal"}},
      {"non-finite",
       [](const EurocFolder& e) { e.edit("imu0/sensor.yaml", "2e-3", ".nan"); },
       {"imu0/sensor.yaml:12:", "accelerometer_noise_density", "not finite"}},
      {"other image size",
       [](const EurocFolder& e) { write_image(e.image(0, 0), pattern(41, 30, 0)); },
       {".png", "41x30", "40x30"}},
      {"truncated first image",
       [](const EurocFolder& e) { truncate_file(e.image(0, 0), 0.7); },
       {".png", "ends early"}},
  };
  for (const Case& c : cases) {
    const TemporaryFolder temporary;
    const EurocFolder euroc(temporary);
    c.spoil(euroc);
    const std::string message = open_error(euroc.root);
    for (const std::string& part : c.parts) EXPECT_THAT(message, HasSubstr(part)) << c.what;
  }
}

TEST(EurocReader, BadImagesInTheMiddleAreMetWhenLoaded) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary);
  truncate_file(euroc.image(1, 2), 0.8);
  write_image(euroc.image(0, 3), pattern(30, 40, 0));
  const auto dataset = open_dataset(euroc.root);
  const std::string stamp2 = std::to_string(EurocFolder::stamp(2)),
                    stamp3 = std::to_string(EurocFolder::stamp(3));
  EXPECT_THAT(input_error([&] { dataset->load(2); }),
              AllOf(HasSubstr("cam1/data/" + stamp2), HasSubstr("ends early")));
  EXPECT_THAT(input_error([&] { dataset->load(3); }),
              AllOf(HasSubstr("cam0/data/" + stamp3), HasSubstr("30x40"), HasSubstr("40x30")));
  EXPECT_EQ(dataset->load(4).left.width, 40);
}

TEST(EurocReader, LoadsFromSeveralThreadsAtOnce) {
  const TemporaryFolder temporary;
  const EurocFolder euroc(temporary, 8);
  const auto dataset = open_dataset(euroc.root);
  std::vector<int> wrong(4, 0);
  {
    std::vector<std::jthread> threads;
    for (std::size_t t = 0; t < wrong.size(); ++t)
      threads.emplace_back([&, t] {
        for (std::size_t i = 0; i < 32; ++i) {
          const std::size_t frame = (i * 3 + t) % dataset->size();
          wrong[t] += dataset->load(frame).left.pixels !=
                      pattern(40, 30, 2 * static_cast<int>(frame)).pixels;
        }
      });
  }
  EXPECT_THAT(wrong, testing::Each(0));
}

}  // namespace
}  // namespace fastloop::io
