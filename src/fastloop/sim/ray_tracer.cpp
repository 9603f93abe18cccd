#include "fastloop/sim/ray_tracer.hpp"

#include "fastloop/sim/wide_vectors.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace fastloop::sim {
namespace {

constexpr int kLeafSize = 2;
constexpr double kBoxPadding = 1e-3;     ///< metres: flat boxes keep a volume in single precision
constexpr float kEdgePadding = 2e-4f;    ///< metres: no cracks between neighbouring surfaces
constexpr float kNearest = 1e-3f;

struct Bounds {
  Vector3d low = Vector3d::Constant(std::numeric_limits<double>::infinity());
  Vector3d high = Vector3d::Constant(-std::numeric_limits<double>::infinity());
  void add(const Bounds& o) {
    low = low.cwiseMin(o.low);
    high = high.cwiseMax(o.high);
  }
  double area() const {
    const Vector3d d = high - low;
    return d.x() * d.y() + d.y() * d.z() + d.z() * d.x();
  }
};

Bounds bounds_of(const Surface& s) {
  Bounds b;
  const Vector3d a = s.length_a * s.axis_a, c = s.length_b * s.axis_b;
  for (const Vector3d& p : {s.origin, Vector3d(s.origin + a), Vector3d(s.origin + c),
                            Vector3d(s.origin + a + c)}) {
    b.low = b.low.cwiseMin(p);
    b.high = b.high.cwiseMax(p);
  }
  b.low.array() -= kBoxPadding;
  b.high.array() += kBoxPadding;
  return b;
}

class BvhBuilder {
 public:
  explicit BvhBuilder(const std::vector<Surface>& surfaces) {
    for (std::size_t i = 0; i < surfaces.size(); ++i) {
      boxes_.push_back(bounds_of(surfaces[i]));
      bvh_.order.push_back(static_cast<std::int32_t>(i));
    }
    bvh_.nodes.emplace_back();
    split(0, 0, static_cast<int>(surfaces.size()));
  }
  Bvh take() { return std::move(bvh_); }

 private:
  void sort(int begin, int end, int axis) {
    std::sort(bvh_.order.begin() + begin, bvh_.order.begin() + end, [&](int i, int j) {
      const double a = boxes_[i].low[axis] + boxes_[i].high[axis];
      const double b = boxes_[j].low[axis] + boxes_[j].high[axis];
      return a != b ? a < b : i < j;
    });
  }
  /// Best place to cut [begin, end) sorted by `axis`, by the surface area heuristic.
  std::pair<double, int> best_cut(int begin, int end) const {
    const int n = end - begin;
    std::vector<double> right_area(n, 0);
    Bounds right, left;
    for (int i = n - 1; i > 0; --i) {
      right.add(boxes_[bvh_.order[begin + i]]);
      right_area[i] = right.area();
    }
    std::pair<double, int> best{std::numeric_limits<double>::infinity(), begin + n / 2};
    for (int i = 1; i < n; ++i) {
      left.add(boxes_[bvh_.order[begin + i - 1]]);
      const double cost = left.area() * i + right_area[i] * (n - i);
      if (cost < best.first) best = {cost, begin + i};
    }
    return best;
  }
  void split(std::size_t node, int begin, int end) {
    Bounds all;
    for (int i = begin; i < end; ++i) all.add(boxes_[bvh_.order[i]]);
    bvh_.nodes[node].low = all.low;
    bvh_.nodes[node].high = all.high;
    if (end - begin <= kLeafSize) {
      bvh_.nodes[node].first = begin;
      bvh_.nodes[node].count = end - begin;
      return;
    }
    std::pair<double, int> best{std::numeric_limits<double>::infinity(), 0};
    int axis = 0;
    for (int k = 0; k < 3; ++k) {
      sort(begin, end, k);
      const auto cut = best_cut(begin, end);
      if (cut.first < best.first) {
        best = cut;
        axis = k;
      }
    }
    sort(begin, end, axis);
    const auto child = static_cast<std::int32_t>(bvh_.nodes.size());
    bvh_.nodes[node].first = child;
    bvh_.nodes[node].axis = axis;
    bvh_.nodes.resize(bvh_.nodes.size() + 2);
    split(child, begin, best.second);
    split(child + 1, best.second, end);
  }

  std::vector<Bounds> boxes_;
  Bvh bvh_;
};

void store(const Vector3d& v, float* out) {
  for (int i = 0; i < 3; ++i) out[i] = static_cast<float>(v[i]);
}

struct alignas(64) WorldRays {
  float x[kLanes], y[kLanes], z[kLanes];
  float ix[kLanes], iy[kLanes], iz[kLanes];  ///< inverse
};

float safe_inverse(float d) {
  constexpr float kSmall = 1e-9f;
  return 1.0f / (std::abs(d) < kSmall ? kSmall : d);
}

template <class Node>
bool reaches(const Node& n, const WorldRays& r, const PacketHits& hits) {
  int any = 0;
  for (int l = 0; l < kLanes; ++l) {
    const float ax = n.low[0] * r.ix[l], bx = n.high[0] * r.ix[l];
    const float ay = n.low[1] * r.iy[l], by = n.high[1] * r.iy[l];
    const float az = n.low[2] * r.iz[l], bz = n.high[2] * r.iz[l];
    const float enter = std::max(std::max(std::min(ax, bx), std::min(ay, by)), std::min(az, bz));
    const float leave = std::min(std::min(std::max(ax, bx), std::max(ay, by)), std::max(az, bz));
    any |= (enter <= std::min(leave, hits.distance[l])) & (leave >= 0.0f);
  }
  return any != 0;
}

void intersect(const TracedView::Plane& p, std::int32_t index, const WorldRays& r, PacketHits& hits) {
  for (int l = 0; l < kLanes; ++l) {
    const float nd = p.n[0] * r.x[l] + p.n[1] * r.y[l] + p.n[2] * r.z[l];
    const float t = p.height / nd;
    const float s = p.s0 + t * (p.a[0] * r.x[l] + p.a[1] * r.y[l] + p.a[2] * r.z[l]);
    const float w = p.t0 + t * (p.b[0] * r.x[l] + p.b[1] * r.y[l] + p.b[2] * r.z[l]);
    const bool hit = (t > kNearest) & (t < hits.distance[l]) & (s >= -kEdgePadding) &
                     (s <= p.length_a + kEdgePadding) & (w >= -kEdgePadding) &
                     (w <= p.length_b + kEdgePadding);
    hits.distance[l] = hit ? t : hits.distance[l];
    hits.surface[l] = hit ? index : hits.surface[l];
  }
}

}  // namespace

Bvh build_bvh(const std::vector<Surface>& surfaces) { return BvhBuilder(surfaces).take(); }

TracedView::TracedView(const World& world, const Bvh& bvh, const SE3& T_world_camera)
    : order_(bvh.order) {
  const Vector3d& camera = T_world_camera.translation;
  const Matrix3d R_world_camera = T_world_camera.rotation.toRotationMatrix();
  for (int i = 0; i < 9; ++i) rotation_[i] = static_cast<float>(R_world_camera(i / 3, i % 3));
  nodes_.resize(bvh.nodes.size());
  for (std::size_t i = 0; i < nodes_.size(); ++i) {
    store(bvh.nodes[i].low - camera, nodes_[i].low);
    store(bvh.nodes[i].high - camera, nodes_[i].high);
    nodes_[i].first = bvh.nodes[i].first;
    nodes_[i].count = bvh.nodes[i].count;
    nodes_[i].axis = bvh.nodes[i].axis;
  }
  planes_.reserve(world.surfaces.size());
  for (const Surface& s : world.surfaces) {
    Plane p;
    const Vector3d n = s.normal(), to_camera = camera - s.origin;
    store(n, p.n);
    store(s.axis_a, p.a);
    store(s.axis_b, p.b);
    store(R_world_camera.transpose() * n, p.n_camera);
    store(R_world_camera.transpose() * s.axis_a, p.a_camera);
    store(R_world_camera.transpose() * s.axis_b, p.b_camera);
    p.height = static_cast<float>(-n.dot(to_camera));
    p.s0 = static_cast<float>(s.axis_a.dot(to_camera));
    p.t0 = static_cast<float>(s.axis_b.dot(to_camera));
    p.length_a = static_cast<float>(s.length_a);
    p.length_b = static_cast<float>(s.length_b);
    planes_.push_back(p);
  }
}

FASTLOOP_WIDE void TracedView::trace(const RayPacket& rays, PacketHits& hits) const {
  WorldRays r;
  const float* m = rotation_;
  for (int l = 0; l < kLanes; ++l) {
    r.x[l] = m[0] * rays.x[l] + m[1] * rays.y[l] + m[2] * rays.z[l];
    r.y[l] = m[3] * rays.x[l] + m[4] * rays.y[l] + m[5] * rays.z[l];
    r.z[l] = m[6] * rays.x[l] + m[7] * rays.y[l] + m[8] * rays.z[l];
    r.ix[l] = safe_inverse(r.x[l]);
    r.iy[l] = safe_inverse(r.y[l]);
    r.iz[l] = safe_inverse(r.z[l]);
    hits.distance[l] = std::numeric_limits<float>::max();
    hits.surface[l] = kSky;
  }
  const bool backwards[3] = {r.x[kLanes / 2] < 0, r.y[kLanes / 2] < 0, r.z[kLanes / 2] < 0};
  std::int32_t stack[96];
  int depth = 0;
  stack[depth++] = 0;
  while (depth > 0) {
    const Node& node = nodes_[stack[--depth]];
    if (!reaches(node, r, hits)) continue;
    if (node.count > 0) {
      for (int i = 0; i < node.count; ++i) {
        const std::int32_t index = order_[node.first + i];
        intersect(planes_[index], index, r, hits);
      }
      continue;
    }
    const int near = backwards[node.axis] ? 1 : 0;  // the nearer child is taken from the stack first
    stack[depth++] = node.first + 1 - near;
    stack[depth++] = node.first + near;
  }
}

}  // namespace fastloop::sim
