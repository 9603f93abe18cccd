#include "fastloop/features/corner_detection.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "fastloop/features/corner_score.hpp"

namespace fastloop {
namespace {

constexpr int kCellPx = 35;
/// Part [begin, end) of the image in which corners may lie.
struct Area {
  int x_begin, y_begin, x_end, y_end;
  int width() const { return x_end - x_begin; }
  int height() const { return y_end - y_begin; }
};

/// The area cut into cells of about kCellPx; the cell of each column and row of pixels.
struct Cells {
  std::vector<std::int32_t> column,
      row_start;  ///< by pixel - begin; row_start: index of the row's first cell
  std::size_t count = 0;

  explicit Cells(const Area& a) : column(a.width()), row_start(a.height()) {
    const int columns = std::max(1, a.width() / kCellPx), rows = std::max(1, a.height() / kCellPx);
    for (int x = 0; x < a.width(); ++x) column[x] = x * columns / a.width();
    for (int y = 0; y < a.height(); ++y) row_start[y] = y * rows / a.height() * columns;
    count = static_cast<std::size_t>(columns) * rows;
  }
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

/// Abscissa of the vertex of the parabola through (-1, before), (0, at), (1, after).
float vertex(int before, int at, int after) {
  const int curvature = before - 2 * at + after;
  if (curvature >= 0) return 0;
  return std::clamp(0.5f * static_cast<float>(before - after) / static_cast<float>(curvature),
                    -0.5f, 0.5f);
}

}  // namespace

void refine_corner(const ImageU8& image, const ImageU8& scores, Corner& corner) {
  // The map has zeros below the floor of the detection; there the score is computed.
  const auto score = [&](int x, int y) {
    const int s = scores.at(x, y);
    return s > 0 ? s : reference::corner_score(image, x, y);
  };
  const int x = corner.x, y = corner.y;
  corner.dx = vertex(score(x - 1, y), corner.score, score(x + 1, y));
  corner.dy = vertex(score(x, y - 1), corner.score, score(x, y + 1));
}

void detect_corners(const ImageU8& image, int border_px, int threshold, int min_threshold,
                    ImageU8& scores, std::vector<Corner>& corners) {
  corners.clear();
  const int border = std::max(border_px, 4);
  const Area area{border, border, image.width - border, image.height - border};
  if (area.width() < 1 || area.height() < 1) return;
  corner_scores(image, min_threshold, scores);
  std::vector<ScorePeak> peaks;
  score_peaks(scores, border, peaks);

  const Cells cells(area);
  std::vector<std::uint8_t> has_strong(cells.count, 0);
  const auto cell_of = [&](const ScorePeak& p) {
    return cells.row_start[p.y - area.y_begin] + cells.column[p.x - area.x_begin];
  };
  for (const ScorePeak& p : peaks)
    if (p.score > threshold) has_strong[cell_of(p)] = 1;
  for (const ScorePeak& p : peaks)
    if (p.score > threshold || !has_strong[cell_of(p)]) corners.push_back({p.x, p.y, p.score});
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
