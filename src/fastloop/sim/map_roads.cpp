#include <algorithm>
#include <cmath>
#include <numeric>
#include <string>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/map_route.hpp"

namespace fastloop::sim {
namespace {

constexpr std::size_t kDetoursOfHub = 3;
constexpr double kMinRadius = 1.0;  // of the bends of a detour, metres

std::size_t num_hubs(std::size_t detours) {
  return (detours + kDetoursOfHub - 1) / kDetoursOfHub;
}

/// Part of the ring that hubs share out between them.
struct HubRange {
  double begin, width;
};
HubRange hub_range(const RouteSizes& sizes) {
  const double begin = sizes.last + 2 * sizes.window, end = 0.8 * sizes.circuit;
  return {begin, (end - begin) / static_cast<double>(num_hubs(sizes.detours.size()))};
}

}  // namespace

RouteSizes route_sizes(const MapWorldOptions& options) {
  const int half = std::max(2, (options.covisible + 3) / 4);
  const auto steps = [&](int count) { return std::clamp(2.0 / half, 0.02, 0.4) * count; };
  RouteSizes sizes;
  sizes.step = steps(1);
  sizes.window = steps(half);
  sizes.shared = steps(half + 5);
  sizes.last = steps(std::max(12, half));
  const double rest = steps(options.keyframes - 1) - sizes.last - options.loops * sizes.shared;
  sizes.circuit = rest * (options.loops == 0 ? 1.0 : options.loops <= 3 ? 0.5 : 0.4);
  for (int i = 0; i < options.loops; ++i) sizes.detours.push_back(0.8 + 0.2 * (i % 3));
  const double weights = std::accumulate(sizes.detours.begin(), sizes.detours.end(), 0.0);
  bool enough = sizes.circuit > 4 * sizes.window + sizes.last + sizes.shared;
  for (double& length : sizes.detours) {
    length *= (rest - sizes.circuit) / weights;
    enough &= length > sizes.shared + 2 * M_PI * kMinRadius;
  }
  if (!sizes.detours.empty()) enough &= hub_range(sizes).width > sizes.shared + 2 * sizes.window;
  if (!enough)
    throw InvalidArgument(std::to_string(options.keyframes) + " keyframes are too few for " +
                          std::to_string(options.loops + 1) + " loops with " +
                          std::to_string(options.covisible) + " covisible keyframes each");
  return sizes;
}

RoadMap::RoadMap(const RouteSizes& sizes)
    : circuit_(sizes.circuit), radius_(sizes.circuit / (2 * M_PI)) {
  for (std::size_t i = 0; i < sizes.detours.size(); ++i) {
    const HubRange hubs = hub_range(sizes);
    const double exit =
        hubs.begin + hubs.width * static_cast<double>(i / kDetoursOfHub + 1) - sizes.window;
    // The bends' radius that makes the detour as long as it should be, by bisection.
    double low = 0, high = sizes.detours[i];
    for (int k = 0; k < 40; ++k) {
      const double middle = 0.5 * (low + high);
      const Polyline line = detour_line(exit - sizes.shared, sizes.shared, middle);
      (line.length.back() < sizes.detours[i] ? low : high) = middle;
    }
    detours_.push_back(detour_line(exit - sizes.shared, sizes.shared, low));
    exits_.push_back(exit);
  }
}

/// A race track beside the stretch [begin, begin + shared] of the ring, bent like the ring, from
/// the stretch's end back to its beginning.
RoadMap::Polyline RoadMap::detour_line(double begin, double shared, double radius) const {
  constexpr int kSamples = 300;
  const double bend = M_PI * radius, total = 2 * bend + shared;
  Polyline line;
  for (int i = 0; i <= kSamples; ++i) {
    const double u = total * i / kSamples;
    double x, y;
    if (u < bend) {
      x = shared + radius * std::sin(u / radius);
      y = radius - radius * std::cos(u / radius);
    } else if (u < bend + shared) {
      x = shared - (u - bend);
      y = 2 * radius;
    } else {
      const double angle = (u - bend - shared) / std::max(radius, 1e-9);
      x = -radius * std::sin(angle);
      y = radius + radius * std::cos(angle);
    }
    const double phi = (begin + x) / radius_;
    line.points.emplace_back((radius_ + y) * std::cos(phi), (radius_ + y) * std::sin(phi), 0);
    line.length.push_back(
        i == 0 ? 0 : line.length.back() + (line.points[i] - line.points[i - 1]).norm());
  }
  return line;
}

double RoadMap::length(std::size_t road) const {
  return road == 0 ? circuit_ : detours_[road - 1].length.back();
}

Vector3d RoadMap::position(std::size_t road, double s) const {
  if (road == 0) return {radius_ * std::cos(s / radius_), radius_ * std::sin(s / radius_), 0};
  const Polyline& line = detours_[road - 1];
  // The straight continuation of the ends lets headings be differences there as well.
  const auto after = std::upper_bound(line.length.begin() + 1, line.length.end() - 1, s);
  const auto i = static_cast<std::size_t>(after - line.length.begin());
  const double f = (s - line.length[i - 1]) / (line.length[i] - line.length[i - 1]);
  return line.points[i - 1] + f * (line.points[i] - line.points[i - 1]);
}

SE3 RoadMap::T_world_carrier(std::size_t road, double s) const {
  constexpr double kReach = 0.3;
  const Vector3d ahead = position(road, s + kReach) - position(road, s - kReach);
  return SE3(so3::exp({0, 0, std::atan2(ahead.y(), ahead.x())}), position(road, s));
}

}  // namespace fastloop::sim
