#pragma once

#include "fastloop/sensor/image.hpp"

namespace fastloop {

/// Gaussian of 7 x 7 pixels, sigma 2, edges mirrored about the outermost pixel: what standard ORB
/// applies to a level before it is described. Within one grey level of OpenCV's, at a third of the
/// time. Images narrower or lower than 4 pixels are copied.
void blur_for_description(const ImageU8& image, ImageU8& blurred);

}  // namespace fastloop
