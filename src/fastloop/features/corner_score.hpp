#pragma once

#include <cstdint>
#include <vector>

#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// FAST-9/16 score of every pixel: the largest d such that nine neighbouring pixels of the circle
/// of radius 3 are all at least d brighter, or all at least d darker, than the centre. Zero where
/// it is at most `floor` or the circle leaves the image. A corner at FAST threshold t is a pixel
/// with score > t.
///
/// Computed densely, 32 pixels at a time: that costs less than scoring the many candidates of a
/// real image one by one, gives both thresholds at once and the neighbours' scores for sub-pixel
/// positions. Uses AVX2 where the CPU has it; the result is the same.
/// @param[out] scores  same size as the image
void corner_scores(const ImageU8& image, int floor, ImageU8& scores);

/// A pixel whose score no neighbour exceeds (of equal neighbours the first in reading order).
struct ScorePeak {
  std::int16_t x, y;
  std::uint8_t score;
};

/// Peaks of the score at least `border_px` (>= 4) from the edge, in reading order.
void score_peaks(const ImageU8& scores, int border_px, std::vector<ScorePeak>& peaks);

namespace reference {
/// One pixel, at least 3 from the edge: what `corner_scores` must equal.
int corner_score(const ImageU8& image, int x, int y);
}  // namespace reference

}  // namespace fastloop
