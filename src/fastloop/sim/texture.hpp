#pragma once

#include "fastloop/sim/world.hpp"

namespace fastloop::sim {

/// Points of one surface that are shaded together.
inline constexpr int kTexels = 8;

struct alignas(32) TexelBlock {
  float s[kTexels], t[kTexels];    ///< surface coordinates, metres
  float su[kTexels], tu[kTexels];  ///< their change to the next pixel right
  float sv[kTexels], tv[kTexels];  ///< their change to the next pixel down
};

/// Brightness (0..255 before exposure) of points of a surface.
///
/// The texture is a stack of layers, coarse to fine. A layer divides the surface into square cells; a hash of
/// the cell puts a box, disc, frame or check of random size, place and grey value into it. Every shape is
/// filtered over the footprint of the pixel, and a layer fades out before its cells come near the size of a
/// pixel: corners exist at every distance, and nothing aliases. No texture repeats.
void shade_texels(const Surface& surface, const TexelBlock& points, float* brightness);

}  // namespace fastloop::sim
