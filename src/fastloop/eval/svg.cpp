#include "fastloop/eval/svg.hpp"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <limits>

namespace fastloop::eval {
namespace {

int decimals_of(double step) {
  return std::max(0, static_cast<int>(-std::floor(std::log10(step) + 1e-9)));
}

/// Positions of grid lines; every power of ten on a logarithmic axis, with 2 and 5 on a short one.
std::vector<double> ticks(double low, double high, bool log, double count) {
  std::vector<double> values;
  if (!log) {
    const double step = nice_step(high - low, count);
    for (double v = std::ceil(low / step) * step; v <= high + 1e-9 * step; v += step)
      values.push_back(v);
    return values;
  }
  const bool dense = std::log10(high / low) < 2.2;
  for (double power = std::pow(10.0, std::floor(std::log10(low))); power <= high; power *= 10)
    for (const double factor : {1.0, 2.0, 5.0})
      if ((dense || factor == 1.0) && factor * power >= low * (1 - 1e-9) &&
          factor * power <= high * (1 + 1e-9))
        values.push_back(factor * power);
  return values;
}

std::string tick_text(double value, bool log, double step) {
  if (!log) return decimal(value, decimals_of(step));
  return decimal(value, value >= 1 ? 0 : decimals_of(value));
}

double fraction(double value, double low, double high, bool log) {
  return log ? std::log(std::max(value, 1e-300) / low) / std::log(high / low)
             : (value - low) / (high - low);
}

}  // namespace

std::string decimal(double value, int decimals) {
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
    else if (c == '"')
      out += "&quot;";
    else
      out += c;
  }
  return out;
}

double nice_step(double span, double count) {
  const double raw = span / count;
  const double power = std::pow(10.0, std::floor(std::log10(raw)));
  for (const double factor : {1.0, 2.0, 5.0})
    if (raw <= factor * power) return factor * power;
  return 10 * power;
}

void Canvas::line(double x1, double y1, double x2, double y2, const char* colour, double width,
                  bool dashed) {
  body_ += "<line x1=\"" + decimal(x1, 1) + "\" y1=\"" + decimal(y1, 1) + "\" x2=\"" +
           decimal(x2, 1) + "\" y2=\"" + decimal(y2, 1) + "\" stroke=\"" + colour +
           "\" stroke-width=\"" + decimal(width, 1) +
           (dashed ? "\" stroke-dasharray=\"4 3\"/>\n" : "\"/>\n");
}

void Canvas::text(double x, double y, const std::string& text, const char* anchor, int size,
                  bool upwards) {
  body_ += "<text x=\"" + decimal(x, 1) + "\" y=\"" + decimal(y, 1) + "\" text-anchor=\"" + anchor +
           "\" font-size=\"" + std::to_string(size) + "\"";
  if (upwards) body_ += " transform=\"rotate(-90 " + decimal(x, 1) + " " + decimal(y, 1) + ")\"";
  body_ += ">" + escaped(text) + "</text>\n";
}

void Canvas::frame(double x, double y, double width, double height) {
  body_ += "<rect x=\"" + decimal(x, 1) + "\" y=\"" + decimal(y, 1) + "\" width=\"" +
           decimal(width, 1) + "\" height=\"" + decimal(height, 1) +
           "\" fill=\"none\" stroke=\"#999999\"/>\n";
}

void Canvas::bar(double x, double y, double width, double height, const char* colour) {
  body_ += "<rect x=\"" + decimal(x, 1) + "\" y=\"" + decimal(y, 1) + "\" width=\"" +
           decimal(width, 1) + "\" height=\"" + decimal(height, 1) + "\" fill=\"" + colour +
           "\"/>\n";
}

void Canvas::dot(double x, double y, const char* colour, double radius, const std::string& tip) {
  body_ += "<circle cx=\"" + decimal(x, 1) + "\" cy=\"" + decimal(y, 1) + "\" r=\"" +
           decimal(radius, 1) + "\" fill=\"" + colour + "\"";
  body_ += tip.empty() ? "/>\n" : "><title>" + escaped(tip) + "</title></circle>\n";
}

void Canvas::polyline(const std::string& points, const char* colour, double width) {
  body_ += "<polyline fill=\"none\" stroke=\"" + std::string(colour) + "\" stroke-width=\"" +
           decimal(width, 1) + "\" stroke-linejoin=\"round\" points=\"" + points + "\"/>\n";
}

std::string Canvas::str(bool fluid) const {
  const std::string box = "viewBox=\"0 0 " + decimal(width_, 0) + " " + decimal(height_, 0) + "\"";
  if (fluid)
    return "<svg xmlns=\"http://www.w3.org/2000/svg\" role=\"img\" " + box +
           " font-family=\"sans-serif\" fill=\"#222222\">\n" + body_ + "</svg>\n";
  return "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" + decimal(width_, 0) +
         "\" height=\"" + decimal(height_, 0) + "\" " + box +
         " font-family=\"sans-serif\" fill=\"#222222\">\n"
         "<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n" +
         body_ + "</svg>\n";
}

double Axes::x(double value) const {
  return left + fraction(value, x_min, x_max, x_log) * width;
}
double Axes::y(double value) const {
  return top + (1 - fraction(value, y_min, y_max, y_log)) * height;
}

void Axes::draw(Canvas& canvas, const std::string& x_label, const std::string& y_label) const {
  const double x_step = nice_step(x_max - x_min, width / 80);
  for (const double v : ticks(x_min, x_max, x_log, width / 80)) {
    canvas.line(x(v), top, x(v), top + height, "#e4e4e4");
    canvas.text(x(v), top + height + 18, tick_text(v, x_log, x_step), "middle", 12);
  }
  const double y_step = nice_step(y_max - y_min, height / 50);
  for (const double v : ticks(y_min, y_max, y_log, height / 50)) {
    canvas.line(left, y(v), left + width, y(v), "#e4e4e4");
    canvas.text(left - 7, y(v) + 4, tick_text(v, y_log, y_step), "end", 12);
  }
  canvas.frame(left, top, width, height);
  canvas.text(left + width / 2, top + height + 38, x_label, "middle");
  canvas.text(left - 50, top + height / 2, y_label, "middle", 13, true);
}

void draw_line(Canvas& canvas, const Axes& axes, const std::vector<Point>& points,
               const std::vector<bool>& breaks, const char* colour, double width) {
  std::string piece;
  Point last{};
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Point pixel{axes.x(points[i][0]), axes.y(points[i][1])};
    const bool gap = i > 0 && i < breaks.size() && breaks[i];
    if (gap) {
      canvas.polyline(piece, colour, width);
      piece.clear();
    }
    const bool visible = std::abs(pixel[0] - last[0]) + std::abs(pixel[1] - last[1]) > 0.5;
    if (!piece.empty() && !visible && i + 1 < points.size()) continue;
    piece += (piece.empty() ? "" : " ") + decimal(pixel[0], 1) + "," + decimal(pixel[1], 1);
    last = pixel;
  }
  canvas.polyline(piece, colour, width);
}

namespace {

constexpr double kLeft = 64, kRight = 14;  ///< margins of a chart

struct Range {
  double low = std::numeric_limits<double>::infinity();
  double high = -std::numeric_limits<double>::infinity();
  void add(double v) {
    low = std::min(low, v);
    high = std::max(high, v);
  }
  /// A range that can be drawn, with some room around the data.
  void widen(bool log, bool from_zero, double room) {
    if (log) {
      low /= 1 + room;
      high *= 1 + room;
      return;
    }
    if (from_zero) low = std::min(low, 0.0);
    const double span = std::max(high - low, std::max(1e-6, 1e-3 * std::abs(high)));
    high = low + span * (1 + room);
    if (!from_zero) low -= span * room;
  }
};

/// Names with their colours above the plot, in as many lines as needed. Returns the height.
double draw_legend(Canvas& canvas, const Chart& chart, double left, double width) {
  double x = left, y = 16;
  const auto entry = [&](const std::string& name, const char* colour, bool dashed, bool dot) {
    const double needed = 34 + 6.6 * static_cast<double>(name.size());
    if (x > left && x + needed > left + width) {
      x = left;
      y += 18;
    }
    if (dot)
      canvas.dot(x + 16, y - 4, colour, 3.2);
    else
      canvas.line(x, y - 4, x + 22, y - 4, colour, dashed ? 1.5 : 3, dashed);
    canvas.text(x + 28, y, name, "start", 12);
    x += needed + 8;
  };
  bool any = false;
  for (const Series& s : chart.series)
    if (!s.name.empty()) {
      entry(s.name, s.colour, false, s.width <= 0);
      any = true;
    }
  std::vector<std::string> named;
  for (const Mark& m : chart.marks)
    if (!m.name.empty() && std::find(named.begin(), named.end(), m.name) == named.end()) {
      entry(m.name, m.colour, true, false);
      named.push_back(m.name);
      any = true;
    }
  return any ? y + 8 : 8;
}

Axes axes_of(const Chart& chart, double top, double height) {
  Range x, y;
  for (const Series& s : chart.series)
    for (const Point& p : s.points) {
      x.add(p[0]);
      y.add(p[1]);
    }
  Axes axes{kLeft,       top,        kChartWidth - kLeft - kRight, height - top - 46, 0, 1, 0, 1,
            chart.x_log, chart.y_log};
  if (chart.equal) {
    const double scale =
        1.06 * std::max({(x.high - x.low) / axes.width, (y.high - y.low) / axes.height, 1e-6});
    const double cx = (x.low + x.high) / 2, cy = (y.low + y.high) / 2;
    x = {cx - scale * axes.width / 2, cx + scale * axes.width / 2};
    y = {cy - scale * axes.height / 2, cy + scale * axes.height / 2};
  } else {
    x.widen(chart.x_log, false, chart.x_log ? 0.1 : 0);
    y.widen(chart.y_log, chart.from_zero, chart.y_log ? 0.15 : 0.06);
  }
  axes.x_min = x.low;
  axes.x_max = x.high;
  axes.y_min = y.low;
  axes.y_max = y.high;
  return axes;
}

}  // namespace

std::string draw_chart(const Chart& chart, double height) {
  const bool empty = std::all_of(chart.series.begin(), chart.series.end(),
                                 [](const Series& s) { return s.points.empty(); });
  if (empty) return "";
  Canvas canvas(kChartWidth, height);
  const double top = draw_legend(canvas, chart, kLeft, kChartWidth - kLeft - kRight);
  const Axes axes = axes_of(chart, top, height);
  axes.draw(canvas, chart.x_label, chart.y_label);
  for (const Mark& m : chart.marks)
    if (m.x >= axes.x_min && m.x <= axes.x_max)
      canvas.line(axes.x(m.x), axes.top, axes.x(m.x), axes.top + axes.height, m.colour, 1.2, true);
  for (const Series& s : chart.series) {
    if (s.width > 0) draw_line(canvas, axes, s.points, s.breaks, s.colour, s.width);
    if (s.dots)
      for (const Point& p : s.points) canvas.dot(axes.x(p[0]), axes.y(p[1]), s.colour, 3.2);
  }
  return canvas.str(true);
}

}  // namespace fastloop::eval
