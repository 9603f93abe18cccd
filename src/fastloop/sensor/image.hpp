#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace fastloop {

/// Owned, row-major, single-channel image without padding.
template <class T>
struct Image {
  int width = 0, height = 0;
  std::vector<T> pixels;  ///< [height * width]

  Image() = default;
  Image(int w, int h) : width(w), height(h), pixels(static_cast<std::size_t>(w) * h) {}

  bool empty() const { return pixels.empty(); }
  T* row(int y) { return pixels.data() + static_cast<std::size_t>(y) * width; }
  const T* row(int y) const { return pixels.data() + static_cast<std::size_t>(y) * width; }
  T& at(int x, int y) { return row(y)[x]; }
  T at(int x, int y) const { return row(y)[x]; }
};

using ImageU8 = Image<std::uint8_t>;  ///< grey values
using ImageF32 = Image<float>;        ///< depth, metres; <= 0 or non-finite means unknown

}  // namespace fastloop
