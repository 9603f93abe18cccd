#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// A FAST-9/16 corner: the score is the largest threshold at which it still is one.
struct Corner {
  std::int16_t x, y;  ///< pixels of its pyramid level
  std::int16_t score;
};

/// FAST corners at least `border_px` from the image's edge, none next to a stronger one. Where a
/// cell of about 35 pixels has none at `threshold`, `min_threshold` is used there.
/// @param[out] corners  replaced; empty when the image is too small. In a fixed order.
void detect_corners(const ImageU8& image, int border_px, int threshold, int min_threshold,
                    std::vector<Corner>& corners);

/// Chooses `count` corners spread evenly over the image: the strongest of every cell of a square
/// grid, the cells as large as the count allows. All of them when there are no more than `count`.
/// @return the chosen ones, in the order given
std::vector<Corner> spread_evenly(std::span<const Corner> corners, int count, int image_width,
                                  int image_height);

/// Peak of the corner score around a corner, from the scores of its four neighbours: within half a
/// pixel.
struct SubPixelOffset {
  float x = 0, y = 0;
};
SubPixelOffset refine_corner(const ImageU8& image, int x, int y);

/// How many features each level gets: in proportion to 1 / factor^level, sum = `total`; what a
/// level cannot fill goes to the others.
/// @param available  [levels] corners found
std::vector<int> share_among_levels(int total, float factor, std::span<const int> available);

}  // namespace fastloop
