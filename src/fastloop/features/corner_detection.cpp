#include "fastloop/features/corner_detection.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <opencv2/features2d.hpp>

#include "fastloop/features/cv_view.hpp"

namespace fastloop {
namespace {

constexpr int kCellPx = 35;
/// FAST looks three pixels around a corner, suppression one more.
constexpr int kMargin = 4;

/// Part [begin, end) of the image in which corners may lie.
struct Area {
  int x_begin, y_begin, x_end, y_end;
  int width() const { return x_end - x_begin; }
  int height() const { return y_end - y_begin; }
};

/// Appends the corners within `area`, which must keep kMargin from the image's edge.
void append_corners(const cv::Mat& image, const Area& area, int threshold,
                    std::vector<cv::KeyPoint>& buffer, std::vector<Corner>& corners) {
  const cv::Rect around(area.x_begin - kMargin, area.y_begin - kMargin, area.width() + 2 * kMargin,
                        area.height() + 2 * kMargin);
  cv::FAST(image(around), buffer, threshold, true);
  for (const cv::KeyPoint& k : buffer) {
    const int x = static_cast<int>(k.pt.x) + around.x, y = static_cast<int>(k.pt.y) + around.y;
    if (x < area.x_begin || y < area.y_begin || x >= area.x_end || y >= area.y_end) continue;
    corners.push_back({static_cast<std::int16_t>(x), static_cast<std::int16_t>(y),
                       static_cast<std::int16_t>(k.response)});
  }
}

/// The area cut into cells of about kCellPx.
struct Cells {
  Area area;
  int columns, rows;
  explicit Cells(const Area& a)
      : area(a),
        columns(std::max(1, a.width() / kCellPx)),
        rows(std::max(1, a.height() / kCellPx)) {}
  int column_of(int x) const { return (x - area.x_begin) * columns / area.width(); }
  int row_of(int y) const { return (y - area.y_begin) * rows / area.height(); }
  /// First pixel whose cell is `column` (or beyond).
  int x_begin(int column) const {
    return area.x_begin + (column * area.width() + columns - 1) / columns;
  }
  int y_begin(int row) const { return area.y_begin + (row * area.height() + rows - 1) / rows; }
};

/// Number of occupied cells of a square grid; `best`, if given, receives the strongest corner of
/// each.
class SpreadGrid {
 public:
  SpreadGrid(std::span<const Corner> corners, int width, int height)
      : corners_(corners), width_(width), height_(height) {}

  int occupied(float cell_px, std::vector<std::int32_t>* best = nullptr) {
    const float inverse = 1.0f / cell_px;
    const int columns = static_cast<int>(width_ * inverse) + 1;
    const int rows = static_cast<int>(height_ * inverse) + 1;
    winner_.assign(static_cast<std::size_t>(columns) * rows, -1);
    int count = 0;
    for (std::size_t i = 0; i < corners_.size(); ++i) {
      const Corner& c = corners_[i];
      auto& w = winner_[static_cast<std::size_t>(c.y * inverse) * columns +
                        static_cast<std::size_t>(c.x * inverse)];
      if (w < 0) ++count;
      if (w < 0 || c.score > corners_[w].score) w = static_cast<std::int32_t>(i);
    }
    if (best) {
      best->clear();
      for (const std::int32_t w : winner_)
        if (w >= 0) best->push_back(w);
    }
    return count;
  }

 private:
  std::span<const Corner> corners_;
  int width_, height_;
  std::vector<std::int32_t> winner_;
};

/// The circle of radius 3 around a pixel, clockwise, as in the FAST paper.
constexpr int kCircle[16][2] = {{0, -3}, {1, -3},  {2, -2},  {3, -1}, {3, 0},  {3, 1},
                                {2, 2},  {1, 3},   {0, 3},   {-1, 3}, {-2, 2}, {-3, 1},
                                {-3, 0}, {-3, -1}, {-2, -2}, {-1, -3}};

/// Largest threshold at which nine neighbouring pixels of the circle are all brighter, or all
/// darker.
int corner_score(const ImageU8& image, int x, int y) {
  constexpr int kLength = 16 + 8;  // the circle and its first half again
  std::int16_t difference[kLength], low[kLength], high[kLength];
  const int centre = image.at(x, y);
  for (int k = 0; k < 16; ++k)
    difference[k] =
        static_cast<std::int16_t>(image.at(x + kCircle[k][0], y + kCircle[k][1]) - centre);
  for (int k = 16; k < kLength; ++k) difference[k] = difference[k - 16];
  std::copy(difference, difference + kLength, low);
  std::copy(difference, difference + kLength, high);
  // Running minimum and maximum over 2, 4 and 8 pixels.
  for (const int reach : {1, 2, 4})
    for (int k = 0; k + reach < kLength; ++k) {
      low[k] = std::min(low[k], low[k + reach]);
      high[k] = std::max(high[k], high[k + reach]);
    }
  int score = 0;
  for (int k = 0; k < 16; ++k) {
    const int brighter = std::min(low[k], difference[k + 8]);
    const int darker = -std::max(high[k], difference[k + 8]);
    score = std::max({score, brighter, darker});
  }
  return score;
}

/// Abscissa of the vertex of the parabola through (-1, before), (0, at), (1, after).
float vertex(int before, int at, int after) {
  const int curvature = before - 2 * at + after;
  if (curvature >= 0) return 0;
  return std::clamp(0.5f * static_cast<float>(before - after) / static_cast<float>(curvature),
                    -0.5f, 0.5f);
}

}  // namespace

SubPixelOffset refine_corner(const ImageU8& image, int x, int y) {
  const int at = corner_score(image, x, y);
  return {vertex(corner_score(image, x - 1, y), at, corner_score(image, x + 1, y)),
          vertex(corner_score(image, x, y - 1), at, corner_score(image, x, y + 1))};
}

void detect_corners(const ImageU8& image, int border_px, int threshold, int min_threshold,
                    std::vector<Corner>& corners) {
  corners.clear();
  const int border = std::max(border_px, kMargin);
  const Area area{border, border, image.width - border, image.height - border};
  if (area.width() < 1 || area.height() < 1) return;
  const cv::Mat mat = as_mat(image);
  std::vector<cv::KeyPoint> buffer;
  append_corners(mat, area, threshold, buffer, corners);
  if (min_threshold >= threshold) return;

  const Cells cells(area);
  std::vector<std::uint8_t> filled(static_cast<std::size_t>(cells.columns) * cells.rows, 0);
  for (const Corner& c : corners)
    filled[cells.row_of(c.y) * cells.columns + cells.column_of(c.x)] = 1;
  for (int row = 0; row < cells.rows; ++row) {
    // Neighbouring empty cells are searched in one go.
    for (int first = 0; first < cells.columns; ++first) {
      if (filled[row * cells.columns + first]) continue;
      int last = first;
      while (last + 1 < cells.columns && !filled[row * cells.columns + last + 1]) ++last;
      const Area gap{cells.x_begin(first), cells.y_begin(row), cells.x_begin(last + 1),
                     cells.y_begin(row + 1)};
      append_corners(mat, gap, min_threshold, buffer, corners);
      first = last;
    }
  }
}

std::vector<Corner> spread_evenly(std::span<const Corner> corners, int count, int image_width,
                                  int image_height) {
  if (count <= 0) return {};
  if (corners.size() <= static_cast<std::size_t>(count)) return {corners.begin(), corners.end()};

  // The largest cell that still leaves enough occupied cells, to a twentieth.
  SpreadGrid grid(corners, image_width, image_height);
  float enough = 1, too_few = static_cast<float>(std::max(image_width, image_height));
  float guess = std::sqrt(static_cast<float>(image_width) * image_height / count);
  while (too_few > 1.05f * enough) {
    if (guess <= enough || guess >= too_few) guess = std::sqrt(enough * too_few);
    (grid.occupied(guess) >= count ? enough : too_few) = guess;
    guess *= 0.8f;
  }
  std::vector<std::int32_t> chosen;
  grid.occupied(enough, &chosen);
  // Drop the weakest of the surplus.
  if (chosen.size() > static_cast<std::size_t>(count)) {
    std::nth_element(chosen.begin(), chosen.begin() + count, chosen.end(), [&](int a, int b) {
      return corners[a].score != corners[b].score ? corners[a].score > corners[b].score : a < b;
    });
    chosen.resize(count);
  }
  std::sort(chosen.begin(), chosen.end());
  std::vector<Corner> result;
  result.reserve(chosen.size());
  for (const std::int32_t i : chosen) result.push_back(corners[i]);
  return result;
}

std::vector<int> share_among_levels(int total, float factor, std::span<const int> available) {
  const std::size_t levels = available.size();
  std::vector<int> share(levels, 0);
  std::vector<bool> open(levels, true);
  int left = std::min(total, std::accumulate(available.begin(), available.end(), 0));
  while (left > 0) {
    double weight_sum = 0;
    for (std::size_t l = 0; l < levels; ++l)
      if (open[l]) weight_sum += std::pow(factor, -static_cast<double>(l));
    // Each open level takes its part of what is left; running totals keep the sum exact.
    double cumulative = 0;
    int given = 0, taken = 0;
    for (std::size_t l = 0; l < levels; ++l) {
      if (!open[l]) continue;
      cumulative += std::pow(factor, -static_cast<double>(l));
      const int offer = static_cast<int>(std::lround(left * cumulative / weight_sum)) - given;
      given += offer;
      const int take = std::min(offer, available[l] - share[l]);
      share[l] += take;
      taken += take;
      open[l] = share[l] < available[l];
    }
    left -= taken;
  }
  return share;
}

}  // namespace fastloop
