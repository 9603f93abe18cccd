// Definitions of test_support.hpp that need OpenCV or are long.
#include "fastloop/io/test_support.hpp"

#include <opencv2/imgcodecs.hpp>

namespace fastloop::io {
namespace {

void write_matrix(const std::filesystem::path& path, const cv::Mat& image) {
  std::filesystem::create_directories(path.parent_path());
  ASSERT_TRUE(cv::imwrite(path.string(), image)) << path;
}

}  // namespace

void write_image(const std::filesystem::path& path, const ImageU8& image) {
  write_matrix(path, cv::Mat(image.height, image.width, CV_8U,
                             const_cast<std::uint8_t*>(image.pixels.data())));
}

void write_image(const std::filesystem::path& path, const Image<std::uint16_t>& image) {
  write_matrix(path, cv::Mat(image.height, image.width, CV_16U,
                             const_cast<std::uint16_t*>(image.pixels.data())));
}

void write_colour_image(const std::filesystem::path& path, int width, int height, int r, int g,
                        int b) {
  write_matrix(path, cv::Mat(height, width, CV_8UC3, cv::Scalar(b, g, r)));
}

ImageU8 pattern(int width, int height, int seed) {
  ImageU8 image(width, height);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      image.at(x, y) = static_cast<std::uint8_t>(60 + 3 * x + 2 * y + 17 * seed);
  return image;
}

void truncate_file(const std::filesystem::path& path, double kept_fraction) {
  const auto size = static_cast<double>(std::filesystem::file_size(path));
  std::filesystem::resize_file(path, static_cast<std::uintmax_t>(size * kept_fraction));
}

EurocFolder::EurocFolder(const TemporaryFolder& temporary, int frame_count)
    : root(temporary.path() / "sequence"), frames(frame_count) {
  for (int camera = 0; camera < 2; ++camera) {
    const std::string name = "sequence/mav0/cam" + std::to_string(camera);
    for (int i = 0; i < frames; ++i)
      write_image(image(camera, i), pattern(kWidth, kHeight, 2 * i + camera));
    temporary.write(name + "/data.csv", image_csv());
    temporary.write(name + "/sensor.yaml", camera_yaml(camera == 0 ? 0.0 : 0.11));
  }
  temporary.write("sequence/mav0/imu0/data.csv", imu_csv());
  temporary.write(
      "sequence/mav0/imu0/sensor.yaml",
      "sensor_type: imu\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0,\n         0, 1, 0, 0,\n"
      "         0, 0, 1, 0,\n         0, 0, 0, 1]\nrate_hz: 200\ngyroscope_noise_density: 1.7e-4\n"
      "gyroscope_random_walk: 2e-5\naccelerometer_noise_density: 2e-3\n"
      "accelerometer_random_walk: 3e-3\n");
}

std::filesystem::path EurocFolder::image(int camera, int frame) const {
  return mav() / ("cam" + std::to_string(camera)) / "data" /
         (std::to_string(stamp(frame)) + ".png");
}

std::string EurocFolder::image_csv() const {
  std::string text = "#timestamp [ns],filename\n";
  for (int i = 0; i < frames; ++i)
    text += std::to_string(stamp(i)) + "," + std::to_string(stamp(i)) + ".png\n";
  return text;
}

std::string EurocFolder::imu_csv() const {
  // From 20 ms before the first frame to 20 ms after the last one; stamps lie 2 ms off the frames'.
  std::string text = "#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n";
  const Nanoseconds end = stamp(frames - 1) + 20'000'000;
  for (Nanoseconds t = kFirstStamp - 18'000'000; t < end; t += kImuGap)
    text += std::to_string(t) + ",0.1,0.2,0.3,0.5,0.25,9.75\n";
  return text;
}

std::string EurocFolder::camera_yaml(double x_m, const std::string& distortion_model) {
  return "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, " +
         std::to_string(x_m) +
         ",\n         0.0, 1.0, 0.0, 0.02,\n         0.0, 0.0, 1.0, 0.03,\n         0.0, 0.0, 0.0, "
         "1.0]\n"
         "rate_hz: 20\nresolution: [40, 30]\ncamera_model: pinhole\nintrinsics: [30.5, 30, 19.5, "
         "14.5] #fu, fv\n"
         "distortion_model: " +
         distortion_model + "\ndistortion_coefficients: [-0.1, 0.02, 0.001, 0.0005]\n";
}

void EurocFolder::edit(const std::string& file, const std::string& from,
                       const std::string& to) const {
  std::string text = read_text_file(mav() / file);
  const std::size_t at = text.find(from);
  ASSERT_NE(at, std::string::npos) << from;
  write_text_file(mav() / file, text.replace(at, from.size(), to));
}

}  // namespace fastloop::io
