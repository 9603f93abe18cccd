#include "fastloop/io/image_file.hpp"

#include <algorithm>
#include <cstdint>
#include <opencv2/imgcodecs.hpp>

#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

constexpr std::uint16_t kUnknownDepth = 65535;

std::uint32_t big_endian(const std::string& bytes, std::size_t at) {
  std::uint32_t value = 0;
  for (std::size_t i = at; i < at + 4; ++i)
    value = value << 8 | static_cast<unsigned char>(bytes[i]);
  return value;
}

std::string incomplete_png_reason(const std::string& bytes) {
  // Chunks: length, type, data, checksum; the last one is IEND.
  std::size_t at = 8;
  while (at + 12 <= bytes.size()) {
    if (bytes.compare(at + 4, 4, "IEND") == 0) return "";
    at += std::size_t{12} + big_endian(bytes, at);
  }
  return "PNG ends early, after " + std::to_string(bytes.size()) + " bytes";
}

std::string incomplete_jpeg_reason(const std::string& bytes) {
  // Some cameras append padding or notes after the end marker.
  const std::size_t tail = bytes.size() - std::min<std::size_t>(bytes.size(), 1024);
  if (bytes.find("\xFF\xD9", tail) != std::string::npos) return "";
  return "JPEG ends early, after " + std::to_string(bytes.size()) + " bytes";
}

cv::Mat decode(const std::filesystem::path& path, int flags) {
  std::error_code missing;
  if (!std::filesystem::exists(path, missing))
    throw InputError(in_file(path), "does not exist", "an image file");
  std::string bytes = read_text_file(path);
  const std::string reason = incomplete_image_reason(bytes);
  if (!reason.empty()) throw InputError(in_file(path), reason, "a complete PNG or JPEG image");
  cv::Mat image;
  try {
    const cv::Mat view(1, static_cast<int>(bytes.size()), CV_8U, bytes.data());
    image = cv::imdecode(view, flags);
  } catch (const cv::Exception& e) {
    throw InputError(in_file(path), "cannot be decoded: " + e.err, "a PNG or JPEG image");
  }
  if (image.empty()) throw InputError(in_file(path), "cannot be decoded: it is damaged", "a PNG or JPEG image");
  return image;
}

cv::Mat decode_grey(const std::filesystem::path& path) {
  // The orientation tag of a JPEG must not turn the picture: the calibration belongs to the stored
  // pixels.
  return decode(path, cv::IMREAD_GRAYSCALE | cv::IMREAD_ANYDEPTH | cv::IMREAD_IGNORE_ORIENTATION);
}

}  // namespace

std::string incomplete_image_reason(const std::string& bytes) {
  if (bytes.empty()) return "is an empty file";
  if (bytes.compare(0, 8, "\x89PNG\r\n\x1a\n") == 0) return incomplete_png_reason(bytes);
  if (bytes.compare(0, 2, "\xFF\xD8") == 0) return incomplete_jpeg_reason(bytes);
  return "is neither PNG nor JPEG";
}

ImageU8 read_grey_image(const std::filesystem::path& path, int significant_bits) {
  const cv::Mat image = decode_grey(path);
  ImageU8 grey(image.cols, image.rows);
  for (int y = 0; y < image.rows; ++y) {
    if (image.depth() == CV_8U) {
      std::copy_n(image.ptr<std::uint8_t>(y), image.cols, grey.row(y));
    } else if (image.depth() == CV_16U) {
      const int shift = significant_bits - 8;
      const std::uint16_t* from = image.ptr<std::uint16_t>(y);
      std::transform(from, from + image.cols, grey.row(y), [shift](std::uint16_t v) {
        return static_cast<std::uint8_t>(std::min(v >> shift, 255));
      });
    } else {
      throw InputError(in_file(path), "has neither 8 nor 16 bits per pixel",
                       "an 8- or 16-bit image");
    }
  }
  return grey;
}

int count_significant_bits(const std::filesystem::path& path) {
  const cv::Mat image = decode_grey(path);
  if (image.depth() != CV_16U) return 8;
  double brightest = 0;
  cv::minMaxLoc(image, nullptr, &brightest);
  for (const int bits : {10, 12, 14})
    if (brightest < static_cast<double>(1 << bits)) return bits;
  return 16;
}

ImageF32 read_depth_image(const std::filesystem::path& path, double units_per_metre) {
  const cv::Mat image = decode(path, cv::IMREAD_UNCHANGED);
  if (image.type() != CV_16UC1)
    throw InputError(in_file(path), "is not a depth image", "a PNG with one 16-bit channel");
  ImageF32 depth(image.cols, image.rows);
  const float metres_per_unit = static_cast<float>(1.0 / units_per_metre);
  for (int y = 0; y < image.rows; ++y) {
    const std::uint16_t* from = image.ptr<std::uint16_t>(y);
    std::transform(from, from + image.cols, depth.row(y), [metres_per_unit](std::uint16_t v) {
      return v == kUnknownDepth ? 0.0F : static_cast<float>(v) * metres_per_unit;
    });
  }
  return depth;
}

}  // namespace fastloop::io
