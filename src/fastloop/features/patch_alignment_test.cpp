#include "fastloop/features/patch_alignment.hpp"

#include <gtest/gtest.h>

#include <cmath>

namespace fastloop {
namespace {

/// A smooth texture, moved by (dx, dy), with its own brightness and contrast.
ImageU8 waves(double dx, double dy, double contrast = 1, double brightness = 0) {
  ImageU8 image(80, 60);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      const double u = x - dx, v = y - dy;
      const double g = 120 + 40 * std::sin(0.5 * u + 0.1 * v) + 30 * std::sin(0.31 * v - 0.2 * u) +
                       20 * std::cos(0.07 * u * u / 10);
      image.at(x, y) = static_cast<std::uint8_t>(std::lround(contrast * g + brightness));
    }
  return image;
}

TEST(PatchAlignment, FindsASubPixelShiftAlongARow) {
  const PatchTemplate patch(waves(0, 0), 40, 30, 1, 0);
  for (const double shift : {-3.7, -1.25, -0.4, 0.0, 0.3, 2.5}) {
    const PatchFit fit = align_along_row(patch, waves(shift, 0, 0.8, 10), 40, 30, 5);
    ASSERT_TRUE(fit.converged) << shift;
    EXPECT_NEAR(fit.shift_px, shift, 0.05);
    EXPECT_GT(fit.correlation, 0.99);
  }
}

TEST(PatchAlignment, FindsAShiftAlongASlantedLine) {
  const double c = std::cos(0.4), s = std::sin(0.4);
  const PatchTemplate patch(waves(0, 0), 40, 30, static_cast<float>(c), static_cast<float>(s));
  const PatchLine line{40, 30, static_cast<float>(c), static_cast<float>(s), {1, 0, 0, 1}};
  for (const double shift : {-1.6, -0.3, 0.8, 1.9}) {
    const PatchFit fit = align_along_line(patch, waves(shift * c, shift * s), line, 4);
    ASSERT_TRUE(fit.converged) << shift;
    EXPECT_NEAR(fit.shift_px, shift, 0.05);
  }
}

TEST(PatchAlignment, RefusesWhatItCannotMatch) {
  const PatchTemplate patch(waves(0, 0), 40, 30, 1, 0);
  ImageU8 flat(80, 60);
  EXPECT_FALSE(align_along_row(patch, flat, 40, 30, 5).converged);
  EXPECT_FALSE(
      align_along_row(PatchTemplate(flat, 40, 30, 1, 0), waves(0, 0), 40, 30, 5).converged);
  const ImageU8 image = waves(0, 0);
  // At and beyond the edges there is nothing to sample.
  for (const auto& [x, y] : {std::pair{-50, 30}, {200, 30}, {40, 2}, {40, 58}})
    EXPECT_FALSE(align_along_row(patch, image, x, y, 5).converged);
  EXPECT_FALSE(align_along_line(patch, image, {2, 30, 1, 0, {1, 0, 0, 1}}, 4).converged);
  EXPECT_FALSE(align_along_line(patch, image, {40, 30, 1, 0, {9, 0, 0, 9}}, 4).converged);
}

}  // namespace
}  // namespace fastloop
