#include "fastloop/features/blur.hpp"

#include <gtest/gtest.h>

#include <opencv2/imgproc.hpp>

#include "fastloop/features/cv_view.hpp"
#include "fastloop/features/scene_for_tests.hpp"

namespace fastloop {
namespace {

TEST(Blur, IsThatOfOpenCvWithinOneGreyLevel) {
  for (const auto& [width, height] : {std::pair{301, 160}, {33, 9}, {4, 4}, {7, 50}}) {
    const ImageU8 image = synthetic_scene::textured_image(width, height, 8);
    cv::Mat expected;
    cv::GaussianBlur(as_mat(image), expected, cv::Size(7, 7), 2, 2, cv::BORDER_REFLECT_101);
    ImageU8 ours;
    blur_for_description(image, ours);
    int different = 0;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        const int difference = std::abs(ours.at(x, y) - expected.at<std::uint8_t>(y, x));
        ASSERT_LE(difference, 1) << x << ", " << y;
        different += difference;
      }
    EXPECT_LE(different, 0.02 * width * height + 1);
  }
}

TEST(Blur, KeepsBlackAndWhite) {
  for (const std::uint8_t grey : {std::uint8_t{0}, std::uint8_t{255}, std::uint8_t{77}}) {
    ImageU8 image(50, 40), blurred;
    std::fill(image.pixels.begin(), image.pixels.end(), grey);
    blur_for_description(image, blurred);
    EXPECT_EQ(blurred.pixels, image.pixels);
    ImageU8 tiny(3, 2);
    blur_for_description(tiny, blurred);
    EXPECT_EQ(blurred.pixels, tiny.pixels);
  }
}

}  // namespace
}  // namespace fastloop
