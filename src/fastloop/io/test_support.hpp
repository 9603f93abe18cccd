#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <string>

#include "fastloop/core/error.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/io/text.hpp"
#include "fastloop/sensor/image.hpp"

/// Helpers of the tests in this folder; not part of the library.
namespace fastloop::io {

/// A fresh folder that is removed at the end of the test.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    path_ =
        std::filesystem::temp_directory_path() /
        ("fastloop_io_" + std::string(test ? test->name() : "x") + "_" + std::to_string(getpid()));
    std::filesystem::remove_all(path_);
    std::filesystem::create_directories(path_);
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  const std::filesystem::path& path() const { return path_; }

  /// Writes a text file, with the folders on the way to it.
  std::filesystem::path write(const std::filesystem::path& name, const std::string& text) const {
    std::filesystem::create_directories((path_ / name).parent_path());
    write_text_file(path_ / name, text);
    return path_ / name;
  }

 private:
  std::filesystem::path path_;
};

/// Writes images with OpenCV (test_support_test.cpp); the ending of the name decides on PNG or
/// JPEG.
void write_image(const std::filesystem::path& path, const ImageU8& image);
void write_image(const std::filesystem::path& path, const Image<std::uint16_t>& image);
/// One colour everywhere.
void write_colour_image(const std::filesystem::path& path, int width, int height, int r, int g,
                        int b);
/// A smooth pattern that differs from seed to seed.
ImageU8 pattern(int width, int height, int seed);
/// Cuts the end of a file off.
void truncate_file(const std::filesystem::path& path, double kept_fraction);

/// An EuRoC folder of small stereo images: 20 Hz from kFirstStamp on, with a 200 Hz IMU around
/// them.
struct EurocFolder {
  static constexpr Nanoseconds kFirstStamp = 1403715273262142976;
  static constexpr Nanoseconds kFrameGap = 50'000'000;
  static constexpr Nanoseconds kImuGap = 5'000'000;
  static constexpr int kWidth = 40, kHeight = 30;

  explicit EurocFolder(const TemporaryFolder& temporary, int frames = 5);
  std::filesystem::path mav() const { return root / "mav0"; }
  std::filesystem::path image(int camera, int frame) const;
  static Nanoseconds stamp(int frame) { return kFirstStamp + frame * kFrameGap; }
  std::string image_csv() const;
  std::string imu_csv() const;
  static std::string camera_yaml(double x_m,
                                 const std::string& distortion_model = "radial-tangential");
  /// Replaces text in a file below mav0.
  void edit(const std::string& file, const std::string& from, const std::string& to) const;

  std::filesystem::path root;
  int frames;
};

/// Message of the InputError that `action` throws; fails the test when it throws none.
template <class Action>
std::string input_error(Action&& action) {
  try {
    action();
  } catch (const InputError& e) {
    return e.what();
  }
  ADD_FAILURE() << "no InputError was thrown";
  return "";
}

}  // namespace fastloop::io
