#pragma once

#include <filesystem>
#include <string>

#include "fastloop/sensor/image.hpp"

/// PNG and JPEG images. A file that ends early is an error, never a half grey picture.
namespace fastloop::io {

/// Grey image; colour is converted (0.299 R + 0.587 G + 0.114 B). Of 16-bit images the upper 8 of
/// `significant_bits` are kept, so that the brightness of a sequence stays comparable between
/// frames.
/// @throws InputError naming the file
ImageU8 read_grey_image(const std::filesystem::path& path, int significant_bits = 16);

/// 8 for an 8-bit image; 10, 12, 14 or 16 for a 16-bit one: the fewest that hold its brightest
/// pixel.
int count_significant_bits(const std::filesystem::path& path);

/// Depth from a 16-bit PNG in metres; 0 where unknown (stored as 0 or 65535).
ImageF32 read_depth_image(const std::filesystem::path& path, double units_per_metre);

/// Reason why the bytes are not one complete PNG or JPEG file, or empty.
std::string incomplete_image_reason(const std::string& bytes);

}  // namespace fastloop::io
