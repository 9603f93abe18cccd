#include "fastloop/sim/world.hpp"

#include <algorithm>
#include <cmath>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/world_builder.hpp"

namespace fastloop::sim {
namespace {

void pillars(WorldBuilder& builder, const Vector3d& low, const Vector3d& high, int count,
             double half_width, double clear_m) {
  for (int i = 0, tries = 0; i < count && tries < 40 * count; ++tries) {
    Block b;
    b.half = {half_width, half_width, 0.5 * (high.z() - low.z())};
    b.yaw = builder.random().uniform(0, M_PI / 2);
    b.centre = {builder.random().uniform(low.x() + 0.6, high.x() - 0.6),
                builder.random().uniform(low.y() + 0.6, high.y() - 0.6), 0.5 * (low.z() + high.z())};
    if (builder.try_block(b, 0.7, false, clear_m)) ++i;
  }
}

World make_room(std::uint64_t seed, std::span<const Vector3d> path) {
  WorldBuilder builder(seed, path);
  const Vector3d low(-4, -3, 0), high(4, 3, 3);
  builder.shell(low, high, 1.3, true);
  pillars(builder, low, high, 3, 0.17, 0.5);
  builder.furnish(low, high, 34, 8, 26, 0.9, 0.45);
  return builder.finish();
}

World make_hall(std::uint64_t seed, std::span<const Vector3d> path) {
  WorldBuilder builder(seed, path);
  const Vector3d low(-12.5, -7.5, 0), high(12.5, 7.5, 8);
  builder.shell(low, high, 2.6, true);
  pillars(builder, low, high, 9, 0.35, 0.9);
  builder.furnish(low, high, 70, 14, 60, 2.4, 0.8);
  return builder.finish();
}

/// Part of a corridor leg with its own distance of the walls on both sides.
struct Section {
  double begin, end, left, right;
};

constexpr double kCorridorHeight = 2.8, kCornerHalf = 2.1;

/// One straight leg between two corner squares; `forward` and `left` are unit vectors of the floor plan.
class CorridorLeg {
 public:
  CorridorLeg(WorldBuilder& builder, const Vector3d& start, const Vector3d& forward, double length)
      : builder_(builder), start_(start), forward_(forward),
        left_(-forward.y(), forward.x(), 0), length_(length) {}

  void build() {
    Section last{0, 0, kCornerHalf, kCornerHalf};
    double at = kCornerHalf;
    const double end = length_ - kCornerHalf;
    while (at < end) {
      double next = at + builder_.random().uniform(5, 13);
      if (end - next < 5) next = end;
      const Section s{at, next, builder_.random().uniform(1.05, 2.0),
                      builder_.random().uniform(1.05, 2.0)};
      step(at, 1, last.left, s.left);
      step(at, -1, last.right, s.right);
      wall(s.begin, s.end, s.left, 1);
      wall(s.begin, s.end, s.right, -1);
      furnish(s);
      last = s;
      at = next;
    }
    step(end, 1, last.left, kCornerHalf);
    step(end, -1, last.right, kCornerHalf);
  }

 private:
  Vector3d point(double along, double across) const {
    return start_ + along * forward_ + across * left_;
  }
  void wall(double begin, double end, double offset, int side) {
    builder_.quad(point(begin, side * offset), (end - begin) * forward_,
                  kCorridorHeight * Vector3d::UnitZ(), 1.1);
  }
  /// Wall across the corridor where its width changes.
  void step(double along, int side, double from, double to) {
    if (std::abs(to - from) < 1e-6) return;
    builder_.quad(point(along, side * from), side * (to - from) * left_,
                  kCorridorHeight * Vector3d::UnitZ(), 0.7);
  }
  void furnish(const Section& s) {
    Random& random = builder_.random();
    const double yaw = std::atan2(forward_.y(), forward_.x());
    const int count = static_cast<int>((s.end - s.begin) * 0.9);
    for (int i = 0; i < count; ++i) {
      const int side = random.integer(2) ? 1 : -1;
      const double offset = side > 0 ? s.left : s.right;
      Block b;
      const bool standing = random.uniform() < 0.35;
      b.half = {random.uniform(0.1, 0.6), standing ? random.uniform(0.08, 0.28) : random.uniform(0.01, 0.06),
                standing ? random.uniform(0.2, 1.1) : random.uniform(0.1, 0.5)};
      b.yaw = yaw;
      b.centre = point(random.uniform(s.begin + 0.7, s.end - 0.7), side * (offset - b.half.y()));
      b.centre.z() = standing ? b.half.z() : random.uniform(0.6, 2.2);
      builder_.try_block(b, 0.4, !standing, 0.4);
    }
    Block beam;  // under the ceiling, across
    beam.half = {random.uniform(0.08, 0.2), 0.5 * (s.left + s.right), random.uniform(0.06, 0.16)};
    beam.yaw = yaw;
    beam.centre = point(random.uniform(s.begin + 0.5, s.end - 0.5), 0.5 * (s.left - s.right));
    beam.centre.z() = kCorridorHeight - beam.half.z();
    builder_.try_block(beam, 0.4, true, 0.4);
  }

  WorldBuilder& builder_;
  Vector3d start_, forward_, left_;
  double length_;
};

World make_corridor(std::uint64_t seed, std::span<const Vector3d> path) {
  WorldBuilder builder(seed, path);
  const std::vector<Eigen::Vector2d> corners = corridor_corners();
  for (std::size_t i = 0; i < corners.size(); ++i) {
    const Eigen::Vector2d a = corners[i], b = corners[(i + 1) % corners.size()];
    const Eigen::Vector2d d = (b - a).normalized();
    const Vector3d forward(d.x(), d.y(), 0), left(-d.y(), d.x(), 0), at(b.x(), b.y(), 0);
    CorridorLeg(builder, Vector3d(a.x(), a.y(), 0), forward, (b - a).norm()).build();
    // The two outer walls of the corner square at the end of this (counter-clockwise) leg.
    const Vector3d outer = at + kCornerHalf * (forward - left), up = kCorridorHeight * Vector3d::UnitZ();
    builder.quad(outer - 2 * kCornerHalf * forward, 2 * kCornerHalf * forward, up, 1.0);
    builder.quad(outer, 2 * kCornerHalf * left, up, 1.0);
  }
  const Vector3d low(-38, -24, 0), size(76, 48, 0);
  const Vector3d x(size.x(), 0, 0), y(0, size.y(), 0);
  builder.quad(low, x, y, 1.0);
  builder.quad(low + y + kCorridorHeight * Vector3d::UnitZ(), x, -y, 1.0);
  return builder.finish();
}

/// A ring of bays. Those of the cloister (`alike`) are images of the first turned about the centre:
/// places that look the same and are not; what closes a loop there must know how far it has come.
World make_ring(std::uint64_t seed, std::span<const Vector3d> path, bool alike) {
  constexpr double kInner = 8.4, kOuter = 11.6, kHeight = 2.8;
  const double step = 2 * M_PI / kRingBays;
  const auto turn = [&](int bay) {
    return Eigen::AngleAxisd(bay * step, Vector3d::UnitZ()).toRotationMatrix();
  };
  // Nothing may stand in the way in any bay: the whole path, seen from the first.
  std::vector<Vector3d> folded;
  for (const Vector3d& p : path)
    folded.push_back(turn(-static_cast<int>(std::lround(std::atan2(p.y(), p.x()) / step))) * p);
  const Vector3d up = kHeight * Vector3d::UnitZ();
  const auto make_bay = [&](std::uint64_t bay_seed) {
    WorldBuilder builder(bay_seed, folded);
    for (const double r : {kInner, kOuter}) {
      const double half = r * std::tan(step / 2);
      builder.quad({r, -half, 0}, {0, 2 * half, 0}, up, 1.0);
    }
    const double half = kOuter * std::tan(step / 2);
    for (const double z : {0.0, kHeight})
      builder.quad({kInner - 0.1, -half, z}, {kOuter - kInner + 0.2, 0, 0}, {0, 2 * half, 0}, 1.0);
    builder.furnish({kInner, -1.7, 0}, {kOuter, 1.7, kHeight}, 10, 4, 8, 0.9, 0.5);
    return builder.finish();
  };
  World ring, bay = make_bay(seed);
  for (int i = 0; i < kRingBays; ++i) {
    if (!alike && i > 0) bay = make_bay(mix64(seed + static_cast<std::uint64_t>(i)));
    for (Surface s : bay.surfaces) {
      // Floors of neighbours overlap near the inner wall; a little step decides which one is seen.
      s.origin = turn(i) * s.origin - Vector3d(0, 0, 0.002 * (i % 2));
      s.axis_a = turn(i) * s.axis_a;
      s.axis_b = turn(i) * s.axis_b;
      ring.surfaces.push_back(s);
    }
  }
  const double reach = 1.02 * kOuter / std::cos(step / 2);
  ring.low = {-reach, -reach, -0.01};
  ring.high = {reach, reach, kHeight};
  return ring;
}

/// Houses along the four sides of a street block, with gaps between some of them.
void street_block(WorldBuilder& builder, const Vector3d& centre) {
  constexpr double kHalf = 0.5 * kCampusPitch - 6;  // streets are 12 m wide
  Random& random = builder.random();
  for (int side = 0; side < 4; ++side) {
    const Matrix3d turn = Eigen::AngleAxisd(side * M_PI / 2, Vector3d::UnitZ()).toRotationMatrix();
    for (double at = -kHalf; at < kHalf - 4;) {
      const double width = std::min(random.uniform(6, 15), kHalf - at);
      const double depth = random.uniform(6, 10), height = random.uniform(5, 15);
      const double setback = random.uniform(0, 1.2);
      Block house;
      house.half = {width / 2, depth / 2, height / 2};
      house.yaw = side * M_PI / 2;
      house.centre = centre + turn * Vector3d(at + width / 2, -kHalf + setback + depth / 2, height / 2);
      builder.try_block(house, 2.6, false, 1.5);
      for (int i = 0; i < 5; ++i) {  // balconies, signs, entrances
        Block part;
        part.half = {random.uniform(0.3, 1.3), random.uniform(0.1, 0.5), random.uniform(0.2, 1.1)};
        part.yaw = house.yaw;
        const double x = random.uniform(at + 1.3, at + width - 1.3);
        part.centre = centre + turn * Vector3d(x, -kHalf + setback - part.half.y(),
                                               random.uniform(part.half.z(), 0.7 * height));
        builder.try_block(part, 0.8, true, 1.5);
      }
      at += width + (random.uniform() < 0.3 ? random.uniform(0.6, 2.5) : 0);
    }
  }
}

World make_campus(std::uint64_t seed, std::span<const Vector3d> path) {
  WorldBuilder builder(seed, path);
  const double p = kCampusPitch;
  builder.quad({-2.6 * p, -1.6 * p, 0}, {5.2 * p, 0, 0}, {0, 4.2 * p, 0}, 3.0);
  for (int i = -2; i < 2; ++i)
    for (int j = -1; j < 2; ++j) street_block(builder, {(i + 0.5) * p, (j + 0.5) * p, 0});
  for (int i = 0; i < 420; ++i) {  // street furniture and poles
    Random& random = builder.random();
    Block b;
    const bool pole = random.uniform() < 0.25;
    b.half = pole ? Vector3d(0.09, 0.09, random.uniform(1.5, 3))
                  : Vector3d(random.uniform(0.2, 1.2), random.uniform(0.2, 0.9), random.uniform(0.3, 1.1));
    b.yaw = random.uniform(0, M_PI);
    const Vector3d& near = path[random.integer(static_cast<int>(path.size()))];
    const double angle = random.uniform(0, 2 * M_PI), away = random.uniform(2.2, 5);
    b.centre = {near.x() + away * std::cos(angle), near.y() + away * std::sin(angle), b.half.z()};
    builder.try_block(b, 0.8, false, 1.6);
  }
  return builder.finish();
}

}  // namespace

World make_world(WorldKind kind, std::uint64_t seed, std::span<const Vector3d> path) {
  switch (kind) {
    case WorldKind::kRoom: return make_room(seed, path);
    case WorldKind::kHall: return make_hall(seed, path);
    case WorldKind::kCorridor: return make_corridor(seed, path);
    case WorldKind::kCampus: return make_campus(seed, path);
    case WorldKind::kRing: return make_ring(seed, path, false);
    case WorldKind::kCloister: return make_ring(seed, path, true);
  }
  throw InvalidArgument("unknown world");
}

World make_world_around(std::uint64_t seed, std::span<const Vector3d> path) {
  if (path.empty()) throw InvalidArgument("a world needs a path to be built around");
  Vector3d low = path[0], high = path[0];
  for (const Vector3d& p : path) {
    low = low.cwiseMin(p);
    high = high.cwiseMax(p);
  }
  const double extent = (high - low).head<2>().maxCoeff();
  const double margin = std::clamp(0.3 * extent, 1.3, 8.0);
  low -= Vector3d(margin, margin, 1.1);
  high += Vector3d(margin, margin, std::clamp(0.2 * extent, 1.3, 6.0));
  const bool large = extent > 40;
  WorldBuilder builder(seed, path);
  const double size = std::clamp(0.1 * extent, 0.9, 4.0);
  builder.shell(low, high, std::clamp(0.15 * extent, 1.2, 3.0), !large);
  pillars(builder, low, high, 4, std::clamp(0.02 * extent, 0.15, 0.4), 0.5);
  builder.furnish(low, high, 36, large ? 0 : 8, 30, size, 0.5);
  // A long way needs things beside it, not only within its bounding box.
  const int beside = large ? static_cast<int>(std::min<std::size_t>(path.size() / 4, 1500)) : 0;
  for (int i = 0; i < beside; ++i) {
    Random& random = builder.random();
    const Vector3d& near = path[random.integer(static_cast<int>(path.size()))];
    const double angle = random.uniform(0, 2 * M_PI), away = random.uniform(2.5, 9);
    Block b;
    b.half = {random.uniform(0.2, 1.6), random.uniform(0.2, 1.6), random.uniform(0.4, 2.6)};
    b.yaw = random.uniform(0, M_PI);
    b.centre = {near.x() + away * std::cos(angle), near.y() + away * std::sin(angle),
                low.z() + b.half.z()};
    builder.try_block(b, 0.8, false, 1.2);
  }
  return builder.finish();
}

std::vector<Vector3d> sample_path(const Trajectory& trajectory, double step_s) {
  std::vector<Vector3d> path;
  for (double t = trajectory.begin_s(); t < trajectory.end_s() + step_s; t += step_s)
    path.push_back(trajectory.pose(t).translation);
  return path;
}

}  // namespace fastloop::sim
