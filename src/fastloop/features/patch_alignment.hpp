#pragma once

#include <array>

#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// Square grey patch around a pixel of one image, normalised, to be found along a line in another.
/// The line is the only freedom: epipolar geometry gives it, so a match gains one sub-pixel
/// coordinate.
struct PatchTemplate {
  static constexpr int kHalf = 5, kSize = 2 * kHalf + 1, kPixels = kSize * kSize;

  std::array<float, kPixels> value;     ///< grey minus mean
  std::array<float, kPixels> gradient;  ///< along the given direction, minus mean
  float norm = 0;                       ///< of `value`; 0 without contrast
  float gradient_sq = 0;                ///< squared norm of `gradient`

  /// @param x, y  pixel, at least kHalf + 1 from the edge
  /// @param dx, dy  direction of the line as seen in this image
  PatchTemplate(const ImageU8& image, int x, int y, float dx, float dy);
};

/// A place in the second image and the line through it.
struct PatchLine {
  float x, y;     ///< pixels
  float dx, dy;   ///< unit vector
  float warp[4];  ///< row-major 2 x 2: pixels of the second image per pixel of the first
};

struct PatchFit {
  bool converged = false;
  float shift_px = 0;     ///< along the line
  float correlation = 0;  ///< zero-mean normalised, at the shift, -1..1
};

/// Gauss-Newton on the shift, from 0; brightness and contrast are free. Not converged when it
/// leaves
/// [-max_shift_px, max_shift_px] or the image.
PatchFit align_along_line(const PatchTemplate& patch, const ImageU8& image, const PatchLine& line,
                          float max_shift_px);

/// The same for a horizontal line and no warp: integer search over +-search_px by correlation, then
/// Gauss-Newton to sub-pixel.
/// @param x, y  pixel of the second image about which to search
PatchFit align_along_row(const PatchTemplate& patch, const ImageU8& image, int x, int y,
                         int search_px);

}  // namespace fastloop
