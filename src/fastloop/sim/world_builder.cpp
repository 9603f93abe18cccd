#include "fastloop/sim/world_builder.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace fastloop::sim {
namespace {

Matrix3d yaw_matrix(double yaw) {
  return Eigen::AngleAxisd(yaw, Vector3d::UnitZ()).toRotationMatrix();
}

double distance(const Block& block, const Vector3d& p) {
  const Vector3d local = yaw_matrix(-block.yaw) * (p - block.centre);
  return (local.cwiseAbs() - block.half).cwiseMax(0.0).norm();
}

double distance(const Surface& s, const Vector3d& p) {
  const Vector3d r = p - s.origin;
  const double a = std::clamp(r.dot(s.axis_a), 0.0, s.length_a);
  const double b = std::clamp(r.dot(s.axis_b), 0.0, s.length_b);
  return (r - a * s.axis_a - b * s.axis_b).norm();
}

}  // namespace

void WorldBuilder::quad(const Vector3d& origin, const Vector3d& a, const Vector3d& b,
                        double coarsest_m) {
  Surface s;
  s.origin = origin;
  s.length_a = a.norm();
  s.length_b = b.norm();
  s.axis_a = a / s.length_a;
  s.axis_b = b / s.length_b;
  s.seed = static_cast<std::uint32_t>(random_.next());
  s.base_grey = static_cast<float>(random_.uniform(75, 175));
  s.coarsest_m = static_cast<float>(coarsest_m * random_.uniform(0.75, 1.3));
  // Light comes from above and a little from one side; lamps make it uneven over a surface.
  const Vector3d n = s.normal();
  const double facing = 0.86 + 0.10 * n.z() + 0.09 * n.x() + 0.05 * n.y();
  for (float& corner : s.light) corner = static_cast<float>(facing * random_.uniform(0.82, 1.16));
  world_.surfaces.push_back(s);
}

void WorldBuilder::block(const Block& block, double coarsest_m, bool with_bottom) {
  const Matrix3d r = yaw_matrix(block.yaw);
  const Vector3d x = 2 * block.half.x() * r.col(0), y = 2 * block.half.y() * r.col(1);
  const Vector3d z = 2 * block.half.z() * Vector3d::UnitZ();
  const Vector3d corner = block.centre - 0.5 * (x + y + z);
  quad(corner, x, z, coarsest_m);              // normals point outwards
  quad(corner + x, y, z, coarsest_m);
  quad(corner + x + y, -x, z, coarsest_m);
  quad(corner + y, -y, z, coarsest_m);
  quad(corner + z, x, y, coarsest_m);
  if (with_bottom) quad(corner, y, x, coarsest_m);
}

bool WorldBuilder::try_block(const Block& candidate, double coarsest_m, bool with_bottom,
                             double clear_m) {
  for (const Vector3d& p : path_)
    if (distance(candidate, p) < clear_m) return false;
  block(candidate, coarsest_m, with_bottom);
  return true;
}

void WorldBuilder::shell(const Vector3d& low, const Vector3d& high, double coarsest_m,
                         bool with_ceiling) {
  const Vector3d size = high - low;
  const Vector3d x(size.x(), 0, 0), y(0, size.y(), 0), z(0, 0, size.z());
  quad(low, x, y, coarsest_m);
  if (with_ceiling) quad(low + z + y, x, -y, coarsest_m);
  quad(low, y, z, coarsest_m);
  quad(low + x + y, -y, z, coarsest_m);
  quad(low + x, -x, z, coarsest_m);
  quad(low + y, x, z, coarsest_m);
}

void WorldBuilder::furnish_flat(const Vector3d& low, const Vector3d& high, double largest_m,
                                double clear_m) {
  const int side = random_.integer(4);
  const double width = random_.uniform(0.3, 1) * largest_m, depth = random_.uniform(0.01, 0.2);
  const double height = random_.uniform(0.3, 1) * largest_m;
  const bool along_x = side < 2;
  const int axis = along_x ? 0 : 1;
  const double room = high[axis] - low[axis];
  if (room < 2.5 * width) return;
  Block b;
  b.half = along_x ? Vector3d(width / 2, depth / 2, height / 2)
                   : Vector3d(depth / 2, width / 2, height / 2);
  b.centre[axis] = random_.uniform(low[axis] + width, high[axis] - width);
  b.centre[1 - axis] = side % 2 ? high[1 - axis] - depth / 2 : low[1 - axis] + depth / 2;
  b.centre.z() = random_.uniform(low.z() + height / 2 + 0.1, high.z() - height / 2 - 0.05);
  try_block(b, 0.5 * std::min(width, height), true, clear_m);
}

void WorldBuilder::furnish(const Vector3d& low, const Vector3d& high, int standing, int hanging,
                           int flat, double largest_m, double clear_m) {
  const auto random_block = [&](double floor, bool hang) {
    Block b;
    b.half = {random_.uniform(0.08, 0.5) * largest_m, random_.uniform(0.08, 0.5) * largest_m,
              random_.uniform(0.1, 0.55) * largest_m};
    b.yaw = random_.uniform(0, M_PI);
    const double reach = b.half.head<2>().norm();
    b.centre = {random_.uniform(low.x() + reach, high.x() - reach),
                random_.uniform(low.y() + reach, high.y() - reach),
                hang ? high.z() - b.half.z() : floor + b.half.z()};
    return b;
  };
  for (int i = 0; i < standing; ++i) {
    const Block b = random_block(low.z(), false);
    if (!try_block(b, 0.5 * b.half.maxCoeff(), false, clear_m)) continue;
    if (random_.uniform() < 0.4) {  // something on top
      Block top = b;
      top.half *= random_.uniform(0.3, 0.8);
      top.yaw += random_.uniform(-0.6, 0.6);
      top.centre.z() = b.centre.z() + b.half.z() + top.half.z();
      try_block(top, 0.5 * top.half.maxCoeff(), false, clear_m);
    }
  }
  for (int i = 0; i < hanging; ++i) {
    const Block b = random_block(0, true);
    try_block(b, 0.5 * b.half.maxCoeff(), true, clear_m);
  }
  for (int i = 0; i < flat; ++i) furnish_flat(low, high, largest_m, clear_m);
}

World WorldBuilder::finish() {
  world_.low.setConstant(std::numeric_limits<double>::infinity());
  world_.high = -world_.low;
  for (const Surface& s : world_.surfaces) {
    const Vector3d far = s.origin + s.length_a * s.axis_a + s.length_b * s.axis_b;
    world_.low = world_.low.cwiseMin(s.origin).cwiseMin(far);
    world_.high = world_.high.cwiseMax(s.origin).cwiseMax(far);
  }
  return std::move(world_);
}

double clearance(const World& world, std::span<const Vector3d> path) {
  double shortest = std::numeric_limits<double>::infinity();
  for (const Surface& s : world.surfaces)
    for (const Vector3d& p : path) shortest = std::min(shortest, distance(s, p));
  return shortest;
}

}  // namespace fastloop::sim
