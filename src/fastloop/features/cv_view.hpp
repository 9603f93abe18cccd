#pragma once

#include <opencv2/core.hpp>

#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// OpenCV headers over our images: no copy, valid while the image lives. For source files only.
inline cv::Mat as_mat(ImageU8& image) {
  return cv::Mat(image.height, image.width, CV_8U, image.pixels.data());
}
/// OpenCV has no read-only matrix: the result must not be written to.
inline const cv::Mat as_mat(const ImageU8& image) {
  return cv::Mat(image.height, image.width, CV_8U, const_cast<std::uint8_t*>(image.pixels.data()));
}

/// Gives the image this size; keeps its memory where it suffices.
inline void resize_storage(ImageU8& image, int width, int height) {
  image.width = width;
  image.height = height;
  image.pixels.resize(static_cast<std::size_t>(width) * height);
}

}  // namespace fastloop
