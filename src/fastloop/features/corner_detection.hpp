#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// A FAST-9/16 corner and how strong it is (see corner_score.hpp).
struct Corner {
  std::int16_t x, y;  ///< pixels of its pyramid level
  std::int16_t score;
  float dx = 0, dy = 0;  ///< peak of the score between the pixels, from (x, y), within half a pixel
};

/// FAST corners at least `border_px` from the image's edge, none next to a stronger one. Where a
/// cell of about 35 pixels has none at `threshold`, `min_threshold` is used there.
/// @param scores  working memory
/// @param[out] corners  replaced; empty when the image is too small. In reading order; dx and dy
/// are zero.
void detect_corners(const ImageU8& image, int border_px, int threshold, int min_threshold,
                    ImageU8& scores, std::vector<Corner>& corners);

/// Sets dx and dy from the scores of the four neighbours.
void refine_corner(const ImageU8& image, const ImageU8& scores, Corner& corner);

/// Chooses `count` corners spread evenly over the image: the strongest of every cell of a square
/// grid, the cells as large as the count allows. All of them when there are no more than `count`.
/// @return the chosen ones, in the order given
std::vector<Corner> spread_evenly(std::span<const Corner> corners, int count, int image_width,
                                  int image_height);

/// How many features each level gets: in proportion to 1 / factor^level, sum = `total`; what a
/// level cannot fill goes to the others.
/// @param available  [levels] corners found
std::vector<int> share_among_levels(int total, float factor, std::span<const int> available);

}  // namespace fastloop
