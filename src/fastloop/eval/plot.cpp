#include "fastloop/eval/plot.hpp"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <utility>

#include "fastloop/core/error.hpp"
#include "fastloop/eval/svg.hpp"

namespace fastloop::eval {
namespace {

constexpr double kWidth = 1200, kHeight = 640;
constexpr const char* kReferenceColour = "#555555";
constexpr const char* kEstimateColour = "#1f6fc4";
constexpr const char* kErrorColour = "#c4441f";

}  // namespace

std::vector<bool> gaps(const std::vector<Nanoseconds>& stamps_ns) {
  std::vector<bool> result(stamps_ns.size(), false);
  if (stamps_ns.size() < 3) return result;
  std::vector<Nanoseconds> steps;
  for (std::size_t i = 1; i < stamps_ns.size(); ++i)
    steps.push_back(stamps_ns[i] - stamps_ns[i - 1]);
  auto sorted = steps;
  const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), middle, sorted.end());
  for (std::size_t i = 0; i < steps.size(); ++i) result[i + 1] = steps[i] > 10 * *middle;
  return result;
}

std::pair<int, int> view_axes(const std::vector<SE3>& poses) {
  Vector3d low = poses[0].translation, high = low;
  for (const SE3& pose : poses) {
    low = low.cwiseMin(pose.translation);
    high = high.cwiseMax(pose.translation);
  }
  const Vector3d extent = high - low;
  if (extent.y() < 0.5 * extent.z() && extent.y() <= extent.x()) return {0, 2};
  if (extent.x() < 0.5 * extent.z()) return {1, 2};
  return {0, 1};
}

namespace {

std::vector<Point> projected(const std::vector<SE3>& poses, std::pair<int, int> axes) {
  std::vector<Point> points;
  for (const SE3& pose : poses)
    points.push_back({pose.translation[axes.first], pose.translation[axes.second]});
  return points;
}

/// Axes around all points with the same scale in both directions.
Axes equal_axes(const std::vector<std::vector<Point>>& lines, double left, double top,
                double size) {
  Point low = lines[0][0], high = low;
  for (const auto& line : lines) {
    for (const Point& p : line) {
      for (std::size_t k = 0; k < 2; ++k) {
        low[k] = std::min(low[k], p[k]);
        high[k] = std::max(high[k], p[k]);
      }
    }
  }
  const double half = 0.54 * std::max({high[0] - low[0], high[1] - low[1], 1e-3});
  const double cx = (low[0] + high[0]) / 2, cy = (low[1] + high[1]) / 2;
  return {left, top, size, size, cx - half, cx + half, cy - half, cy + half};
}

void draw_paths(Canvas& canvas, const Evaluation& e) {
  static constexpr const char* kAxisName[] = {"x [m]", "y [m]", "z [m]"};
  const auto view = view_axes(e.reference);
  const auto reference = projected(e.reference, view), estimate = projected(e.estimate, view);
  const Axes axes = equal_axes({reference, estimate}, 80, 60, 520);
  axes.draw(canvas, kAxisName[view.first], kAxisName[view.second]);
  const auto breaks = gaps(e.stamps_ns);
  draw_line(canvas, axes, reference, breaks, kReferenceColour, 2.4);
  draw_line(canvas, axes, estimate, breaks, kEstimateColour, 1.3);
  canvas.dot(axes.x(estimate[0][0]), axes.y(estimate[0][1]), kEstimateColour);
  canvas.text(axes.x(estimate[0][0]) + 7, axes.y(estimate[0][1]) - 6, "start", "start", 12);
}

void draw_errors(Canvas& canvas, const Evaluation& e) {
  std::vector<Point> points;
  for (std::size_t i = 0; i < e.errors_m.size(); ++i)
    points.push_back({to_seconds(e.stamps_ns[i] - e.stamps_ns[0]), e.errors_m[i]});
  const Axes axes{
      700, 60, 460, 250, 0, std::max(points.back()[0], 1e-3), 0, std::max(1.1 * e.ate_m.max, 1e-6)};
  axes.draw(canvas, "time since the first matched pose [s]", "position error [m]");
  draw_line(canvas, axes, points, gaps(e.stamps_ns), kErrorColour, 1.3);
  canvas.line(axes.left, axes.y(e.ate_m.rmse), axes.left + axes.width, axes.y(e.ate_m.rmse),
              "#222222", 0.8);
  canvas.text(axes.left + axes.width + 4, axes.y(e.ate_m.rmse) + 4, "RMSE", "start", 11);
}

void draw_legend(Canvas& canvas, const Evaluation& e) {
  double y = 395;
  const auto key = [&](const char* colour, const std::string& text) {
    canvas.line(700, y - 4, 730, y - 4, colour, 3);
    canvas.text(738, y, text);
    y += 20;
  };
  const auto row = [&](const std::string& name, const std::string& value) {
    canvas.text(700, y, name);
    canvas.text(820, y, value);
    y += 20;
  };
  key(kReferenceColour, "ground truth");
  key(kEstimateColour, e.alignment.scale == 1
                           ? std::string("estimate")
                           : "estimate, scaled by " + decimal(e.alignment.scale, 4));
  y += 6;
  row("ATE", "RMSE " + decimal(e.ate_m.rmse, 4) + " m,  median " + decimal(e.ate_m.median, 4) +
                 " m,  max " + decimal(e.ate_m.max, 4) + " m");
  row("of the path", decimal(e.ate_percent, 3) + " %  of  " + decimal(e.path_length_m, 2) + " m");
  row("matched", std::to_string(e.errors_m.size()) + " of " + std::to_string(e.estimate_poses) +
                     " poses,  coverage " + decimal(100 * e.coverage, 1) + " %");
  if (!e.rpe) return;
  row("RPE over " + decimal(e.rpe->seconds, 2) + " s",
      "RMSE " + decimal(e.rpe->translation_m.rmse, 4) + " m,  " +
          decimal(e.rpe->rotation_deg.rmse, 3) + " deg");
}

}  // namespace

std::string to_svg(const Evaluation& evaluation, const std::string& title) {
  if (evaluation.reference.empty()) throw InvalidArgument("to_svg: nothing to draw");
  Canvas canvas(kWidth, kHeight);
  canvas.text(80, 34, title, "start", 17);
  draw_paths(canvas, evaluation);
  draw_errors(canvas, evaluation);
  draw_legend(canvas, evaluation);
  return canvas.str();
}

void write_svg(const std::filesystem::path& file, const Evaluation& evaluation,
               const std::string& title) {
  const std::string svg = to_svg(evaluation, title);
  std::ofstream out(file, std::ios::binary | std::ios::trunc);
  if (out) out << svg;
  out.close();
  if (!out)
    throw InputError({file.string(), 0, ""}, "could not be written", "a writable file with space");
}

}  // namespace fastloop::eval
