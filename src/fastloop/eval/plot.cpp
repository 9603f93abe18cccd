#include "fastloop/eval/plot.hpp"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <fstream>
#include <utility>

#include "fastloop/core/error.hpp"

namespace fastloop::eval {
namespace {

constexpr double kWidth = 1200, kHeight = 640;
constexpr const char* kReferenceColour = "#555555";
constexpr const char* kEstimateColour = "#1f6fc4";
constexpr const char* kErrorColour = "#c4441f";

/// Decimal text that does not depend on the locale.
std::string number(double value, int decimals) {
  if (std::abs(value) < 0.5 * std::pow(10.0, -decimals)) value = 0;
  char buffer[400];
  const auto end =
      std::to_chars(buffer, buffer + sizeof buffer, value, std::chars_format::fixed, decimals).ptr;
  return {buffer, end};
}

std::string escaped(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if (c == '&')
      out += "&amp;";
    else if (c == '<')
      out += "&lt;";
    else if (c == '>')
      out += "&gt;";
    else
      out += c;
  }
  return out;
}

/// Collects SVG elements. Coordinates are pixels, y down.
class Canvas {
 public:
  void line(double x1, double y1, double x2, double y2, const char* colour, double width = 1) {
    body_ += "<line x1=\"" + number(x1, 1) + "\" y1=\"" + number(y1, 1) + "\" x2=\"" +
             number(x2, 1) + "\" y2=\"" + number(y2, 1) + "\" stroke=\"" + colour +
             "\" stroke-width=\"" + number(width, 1) + "\"/>\n";
  }
  void text(double x, double y, const std::string& text, const char* anchor = "start",
            int size = 13, bool upwards = false) {
    body_ += "<text x=\"" + number(x, 1) + "\" y=\"" + number(y, 1) + "\" text-anchor=\"" + anchor +
             "\" font-size=\"" + std::to_string(size) + "\"";
    if (upwards) body_ += " transform=\"rotate(-90 " + number(x, 1) + " " + number(y, 1) + ")\"";
    body_ += ">" + escaped(text) + "</text>\n";
  }
  void frame(double x, double y, double width, double height) {
    body_ += "<rect x=\"" + number(x, 1) + "\" y=\"" + number(y, 1) + "\" width=\"" +
             number(width, 1) + "\" height=\"" + number(height, 1) +
             "\" fill=\"none\" stroke=\"#999999\"/>\n";
  }
  void dot(double x, double y, const char* colour) {
    body_ += "<circle cx=\"" + number(x, 1) + "\" cy=\"" + number(y, 1) + "\" r=\"4\" fill=\"" +
             colour + "\"/>\n";
  }
  void polyline(const std::string& points, const char* colour, double width) {
    body_ += "<polyline fill=\"none\" stroke=\"" + std::string(colour) + "\" stroke-width=\"" +
             number(width, 1) + "\" stroke-linejoin=\"round\" points=\"" + points + "\"/>\n";
  }
  std::string str() const {
    const std::string size = number(kWidth, 0) + "\" height=\"" + number(kHeight, 0);
    return "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" + size + "\" viewBox=\"0 0 " +
           number(kWidth, 0) + " " + number(kHeight, 0) +
           "\" font-family=\"sans-serif\" fill=\"#222222\">\n"
           "<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n" +
           body_ + "</svg>\n";
  }

 private:
  std::string body_;
};

/// A step of 1, 2 or 5 times a power of ten that cuts `span` into about `count` parts.
double nice_step(double span, double count) {
  const double raw = span / count;
  const double power = std::pow(10.0, std::floor(std::log10(raw)));
  for (const double factor : {1.0, 2.0, 5.0})
    if (raw <= factor * power) return factor * power;
  return 10 * power;
}

int decimals_of(double step) {
  return std::max(0, static_cast<int>(-std::floor(std::log10(step) + 1e-9)));
}

/// One set of axes: data ranges mapped onto a rectangle of the canvas.
struct Axes {
  double left, top, width, height;
  double x_min, x_max, y_min, y_max;

  double x(double value) const { return left + (value - x_min) / (x_max - x_min) * width; }
  double y(double value) const { return top + (y_max - value) / (y_max - y_min) * height; }

  void draw(Canvas& canvas, const std::string& x_label, const std::string& y_label) const {
    const double x_step = nice_step(x_max - x_min, width / 80);
    for (double v = std::ceil(x_min / x_step) * x_step; v <= x_max; v += x_step) {
      canvas.line(x(v), top, x(v), top + height, "#e4e4e4");
      canvas.text(x(v), top + height + 18, number(v, decimals_of(x_step)), "middle", 12);
    }
    const double y_step = nice_step(y_max - y_min, height / 60);
    for (double v = std::ceil(y_min / y_step) * y_step; v <= y_max; v += y_step) {
      canvas.line(left, y(v), left + width, y(v), "#e4e4e4");
      canvas.text(left - 7, y(v) + 4, number(v, decimals_of(y_step)), "end", 12);
    }
    canvas.frame(left, top, width, height);
    canvas.text(left + width / 2, top + height + 38, x_label, "middle");
    canvas.text(left - 50, top + height / 2, y_label, "middle", 13, true);
  }
};

using Point = std::array<double, 2>;

/// Draws a line through data points, broken where `breaks` says that the next point does not
/// follow. Points nearer than half a pixel to the last drawn one are left out: they cannot be seen.
void draw_line(Canvas& canvas, const Axes& axes, const std::vector<Point>& points,
               const std::vector<bool>& breaks, const char* colour, double width) {
  std::string piece;
  Point last{};
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Point pixel{axes.x(points[i][0]), axes.y(points[i][1])};
    const bool gap = i > 0 && breaks[i];
    if (gap) {
      canvas.polyline(piece, colour, width);
      piece.clear();
    }
    const bool visible = std::abs(pixel[0] - last[0]) + std::abs(pixel[1] - last[1]) > 0.5;
    if (!piece.empty() && !visible && i + 1 < points.size()) continue;
    piece += (piece.empty() ? "" : " ") + number(pixel[0], 1) + "," + number(pixel[1], 1);
    last = pixel;
  }
  canvas.polyline(piece, colour, width);
}

/// True at the first pose after a gap of more than ten usual steps.
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

/// The two axes in which the reference moves most, in the order x, y, z; x and y when it is close.
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
                           : "estimate, scaled by " + number(e.alignment.scale, 4));
  y += 6;
  row("ATE", "RMSE " + number(e.ate_m.rmse, 4) + " m,  median " + number(e.ate_m.median, 4) +
                 " m,  max " + number(e.ate_m.max, 4) + " m");
  row("of the path", number(e.ate_percent, 3) + " %  of  " + number(e.path_length_m, 2) + " m");
  row("matched", std::to_string(e.errors_m.size()) + " of " + std::to_string(e.estimate_poses) +
                     " poses,  coverage " + number(100 * e.coverage, 1) + " %");
  if (!e.rpe) return;
  row("RPE over " + number(e.rpe->seconds, 2) + " s",
      "RMSE " + number(e.rpe->translation_m.rmse, 4) + " m,  " +
          number(e.rpe->rotation_deg.rmse, 3) + " deg");
}

}  // namespace

std::string to_svg(const Evaluation& evaluation, const std::string& title) {
  if (evaluation.reference.empty()) throw InvalidArgument("to_svg: nothing to draw");
  Canvas canvas;
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
