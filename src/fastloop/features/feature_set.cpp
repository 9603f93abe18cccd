#include "fastloop/features/feature_set.hpp"

#include <limits>

#include "fastloop/core/error.hpp"

namespace fastloop {

PyramidScales::PyramidScales(int num_levels, float scale_factor)
    : levels(num_levels), factor(scale_factor) {
  if (num_levels < 1 || num_levels > 255)
    throw InvalidArgument("PyramidScales: the number of levels must be in 1..255");
  if (!(scale_factor > 1)) throw InvalidArgument("PyramidScales: the scale factor must exceed 1");
  double s = 1;
  for (int i = 0; i < num_levels; ++i, s *= scale_factor) {
    scale.push_back(static_cast<float>(s));
    sigma2.push_back(static_cast<float>(s * s));
  }
}

void KeypointGrid::build(std::span<const float> x, std::span<const float> y, int image_width,
                         int image_height) {
  if (x.size() != y.size()) throw InvalidArgument("KeypointGrid: x and y differ in length");
  if (x.size() > std::numeric_limits<std::uint16_t>::max())
    throw InvalidArgument("KeypointGrid: more than 65,535 keypoints");
  if (image_width <= 0 || image_height <= 0) throw InvalidArgument("KeypointGrid: empty image");
  cell_width_px = static_cast<float>(image_width) / kCols;
  cell_height_px = static_cast<float>(image_height) / kRows;

  // Counting sort by cell; it is stable, so indices ascend within a cell.
  std::vector<std::uint16_t> cell(x.size());
  start.assign(kCols * kRows + 1, 0);
  for (std::size_t i = 0; i < x.size(); ++i) {
    cell[i] = static_cast<std::uint16_t>(row_of(y[i]) * kCols + column_of(x[i]));
    ++start[cell[i] + 1];
  }
  for (std::size_t c = 1; c < start.size(); ++c) start[c] += start[c - 1];
  indices.resize(x.size());
  std::vector<std::uint32_t> next(start.begin(), start.end() - 1);
  for (std::size_t i = 0; i < x.size(); ++i)
    indices[next[cell[i]]++] = static_cast<std::uint16_t>(i);
}

std::uint64_t ContentId::assign() const {
  static std::atomic<std::uint64_t> last{0};
  std::uint64_t none = 0;
  if (id_ == 0) id_.compare_exchange_strong(none, ++last);  // a number nobody takes is lost
  return id_;
}

}  // namespace fastloop
