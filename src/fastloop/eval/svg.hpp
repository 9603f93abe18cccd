#pragma once

#include <array>
#include <string>
#include <vector>

namespace fastloop::eval {

/// Decimal text that does not depend on the locale.
std::string decimal(double value, int decimals);
/// Text that may stand in XML, in attributes too.
std::string escaped(const std::string& text);
/// A step of 1, 2 or 5 times a power of ten that cuts `span` into about `count` parts.
double nice_step(double span, double count);

/// Collects SVG elements. Coordinates are pixels, y down.
class Canvas {
 public:
  Canvas(double width, double height) : width_(width), height_(height) {}

  void line(double x1, double y1, double x2, double y2, const char* colour, double width = 1,
            bool dashed = false);
  void text(double x, double y, const std::string& text, const char* anchor = "start",
            int size = 13, bool upwards = false);
  void frame(double x, double y, double width, double height);
  void bar(double x, double y, double width, double height, const char* colour);
  /// @param tip  shown when the pointer rests on it; may be empty
  void dot(double x, double y, const char* colour, double radius = 4, const std::string& tip = "");
  void polyline(const std::string& points, const char* colour, double width);
  /// The whole picture. With `fluid`, it takes the width it is given in a page.
  std::string str(bool fluid = false) const;

 private:
  double width_, height_;
  std::string body_;
};

using Point = std::array<double, 2>;

/// One set of axes: data ranges mapped onto a rectangle of the canvas.
struct Axes {
  double left, top, width, height;
  double x_min, x_max, y_min, y_max;
  bool x_log = false, y_log = false;

  double x(double value) const;
  double y(double value) const;
  void draw(Canvas& canvas, const std::string& x_label, const std::string& y_label) const;
};

/// Draws a line through data points, broken where `breaks` says that the next point does not
/// follow (empty: nowhere). Points nearer than half a pixel to the last drawn one are left out:
/// they cannot be seen.
void draw_line(Canvas& canvas, const Axes& axes, const std::vector<Point>& points,
               const std::vector<bool>& breaks, const char* colour, double width);

/// Lines or dots of a chart.
struct Series {
  std::string name;
  const char* colour = "#1f6fc4";
  std::vector<Point> points;
  std::vector<bool> breaks;
  double width = 1.5;  ///< 0: no line
  bool dots = false;  ///< marks each point
};

/// A vertical line with a meaning, such as a loop.
struct Mark {
  double x = 0;
  const char* colour = "#2a7f3f";
  std::string name;  ///< in the legend, once
};

struct Chart {
  std::string x_label, y_label;
  std::vector<Series> series;
  std::vector<Mark> marks;
  bool x_log = false, y_log = false;
  bool equal = false;     ///< same scale in both directions
  bool from_zero = true;  ///< the y axis begins at zero unless it is logarithmic
};

inline constexpr double kChartWidth = 460;

/// A chart as an SVG element for a page: fluid, narrow enough that its text stays readable on a
/// phone. Empty when there is nothing to draw.
std::string draw_chart(const Chart& chart, double height = 300);

}  // namespace fastloop::eval
