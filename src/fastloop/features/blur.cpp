#include "fastloop/features/blur.hpp"

#include <array>
#include <cstdint>
#include <cstdlib>

#include "fastloop/features/cv_view.hpp"

namespace fastloop {
namespace {

constexpr int kRadius = 3;
/// Centre and sides of the kernel, in 1/256; they add up to 1.
constexpr std::uint16_t kWeight[kRadius + 1] = {56, 48, 34, 18};
static_assert(kWeight[0] + 2 * (kWeight[1] + kWeight[2] + kWeight[3]) == 256);

/// Index mirrored into [0, n).
int mirrored(int i, int n) {
  return i < 0 ? -i : i >= n ? 2 * n - 2 - i : i;
}

/// Seven rows into one, 1/128 grey levels: 15 bits, so that two of them add up within 16.
__attribute__((always_inline)) inline void blur_columns(
    const std::uint8_t* const (&rows)[2 * kRadius + 1], int width, std::uint16_t* __restrict out) {
  for (int x = 0; x < width; ++x) {
    const auto sum = static_cast<std::uint16_t>(
        kWeight[0] * rows[3][x] + kWeight[1] * (rows[2][x] + rows[4][x]) +
        kWeight[2] * (rows[1][x] + rows[5][x]) + kWeight[3] * (rows[0][x] + rows[6][x]));
    out[x] = static_cast<std::uint16_t>(sum >> 1);
  }
}

__attribute__((always_inline)) inline std::uint16_t scaled(std::uint16_t value,
                                                           std::uint16_t weight) {
  return static_cast<std::uint16_t>(
      (static_cast<std::uint32_t>(value) * static_cast<std::uint32_t>(weight << 8)) >> 16);
}

/// A row with kRadius more pixels on either side into grey levels. Each of the four products is cut
/// off below, by half a unit on average: the rounding constant includes these two units.
__attribute__((always_inline)) inline void blur_row(const std::uint16_t* __restrict in, int width,
                                                    std::uint8_t* __restrict out) {
  for (int x = 0; x < width; ++x) {
    const std::uint16_t* p = in + x;
    const auto pair = [p](int reach) {
      return static_cast<std::uint16_t>(p[kRadius - reach] + p[kRadius + reach]);
    };
    const auto sum =
        static_cast<std::uint16_t>(scaled(p[kRadius], kWeight[0]) + scaled(pair(1), kWeight[1]) +
                                   scaled(pair(2), kWeight[2]) + scaled(pair(3), kWeight[3]));
    out[x] = static_cast<std::uint8_t>(static_cast<std::uint16_t>(sum + 66) >> 7);
  }
}

__attribute__((always_inline)) inline void blur_image(const ImageU8& image, std::uint16_t* line,
                                                      ImageU8& blurred) {
  const int width = image.width;
  for (int y = 0; y < image.height; ++y) {
    const std::uint8_t* rows[2 * kRadius + 1];
    for (int v = -kRadius; v <= kRadius; ++v)
      rows[v + kRadius] = image.row(mirrored(y + v, image.height));
    std::uint16_t* inner = line + kRadius;
    blur_columns(rows, width, inner);
    for (int i = 1; i <= kRadius; ++i) {
      inner[-i] = inner[i];
      inner[width - 1 + i] = inner[width - 1 - i];
    }
    blur_row(line, width, blurred.row(y));
  }
}

void blur_portable(const ImageU8& image, std::uint16_t* line, ImageU8& blurred) {
  blur_image(image, line, blurred);
}
#if defined(__x86_64__)
__attribute__((target("avx2"))) void blur_avx2(const ImageU8& image, std::uint16_t* line,
                                               ImageU8& blurred) {
  blur_image(image, line, blurred);
}
const bool kHasAvx2 = __builtin_cpu_supports("avx2");
#else
constexpr auto blur_avx2 = blur_portable;
constexpr bool kHasAvx2 = false;
#endif

}  // namespace

void blur_for_description(const ImageU8& image, ImageU8& blurred) {
  if (image.width <= kRadius || image.height <= kRadius) {
    blurred = image;
    return;
  }
  resize_storage(blurred, image.width, image.height);
  std::vector<std::uint16_t> line(static_cast<std::size_t>(image.width) + 2 * kRadius);
  (kHasAvx2 ? blur_avx2 : blur_portable)(image, line.data(), blurred);
}

}  // namespace fastloop
