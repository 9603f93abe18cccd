#include "fastloop/matching/sight_batch.hpp"

#include <algorithm>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#define FASTLOOP_AVX2 __attribute__((target("avx2"), always_inline)) inline
#endif

namespace fastloop::matching {

#if defined(__x86_64__) && defined(__GNUC__)
namespace {

// The target attribute leaves fused multiply-add out, and every expression is written in the order
// of projection_math.hpp and camera_view.hpp: lanes get the bits of the scalar functions.

FASTLOOP_AVX2 __m256 all(float value) {
  return _mm256_set1_ps(value);
}
FASTLOOP_AVX2 __m256 select(__m256 condition, __m256 yes, __m256 no) {
  return _mm256_blendv_ps(no, yes, condition);
}
FASTLOOP_AVX2 __m256 less(__m256 a, __m256 b) {
  return _mm256_cmp_ps(a, b, _CMP_LT_OQ);
}
FASTLOOP_AVX2 __m256 at_most(__m256 a, __m256 b) {
  return _mm256_cmp_ps(a, b, _CMP_LE_OQ);
}
FASTLOOP_AVX2 __m256 both(__m256 a, __m256 b) {
  return _mm256_and_ps(a, b);
}
FASTLOOP_AVX2 __m256 negative(__m256 a) {
  return _mm256_xor_ps(a, all(-0.0f));
}

struct Vector3x8 {
  __m256 x, y, z;
};

/// Eight consecutive 3-vectors. The elements of one coordinate fall on eight different positions
/// modulo 8, so blending the three loads collects them and one permutation puts them in order.
FASTLOOP_AVX2 Vector3x8 load3(const float* p) {
  const __m256 a = _mm256_loadu_ps(p), b = _mm256_loadu_ps(p + 8), c = _mm256_loadu_ps(p + 16);
  // Positions of x: 0 3 6 | 9 12 15 | 18 21, of y one more, of z two more.
  const __m256 x = _mm256_blend_ps(_mm256_blend_ps(a, b, 0b10010010), c, 0b00100100);
  const __m256 y = _mm256_blend_ps(_mm256_blend_ps(a, b, 0b00100100), c, 0b01001001);
  const __m256 z = _mm256_blend_ps(_mm256_blend_ps(a, b, 0b01001001), c, 0b10010010);
  return {_mm256_permutevar8x32_ps(x, _mm256_setr_epi32(0, 3, 6, 1, 4, 7, 2, 5)),
          _mm256_permutevar8x32_ps(y, _mm256_setr_epi32(1, 4, 7, 2, 5, 0, 3, 6)),
          _mm256_permutevar8x32_ps(z, _mm256_setr_epi32(2, 5, 0, 3, 6, 1, 4, 7))};
}

FASTLOOP_AVX2 __m256 atan_unit(__m256 u) {
  const __m256 a = _mm256_andnot_ps(all(-0.0f), u);
  const __m256 reduce = less(all(0.41421356f), a);
  const __m256 x = select(reduce, (a - all(1.0f)) / (a + all(1.0f)), a);
  const __m256 z = x * x;
  const __m256 tail =
      z * (all(-0.333327565f) +
           z * (all(0.199718745f) + z * (all(-0.138244114f) + z * all(0.0790248152f))));
  __m256 angle = x + x * tail;
  angle = select(reduce, angle + all(0.785398163f), angle);
  return select(less(u, all(0)), negative(angle), angle);
}

FASTLOOP_AVX2 __m256 axis_angle(__m256 r, __m256 z) {
  const __m256 ahead = at_most(r, z);
  const __m256 aside = _mm256_andnot_ps(ahead, at_most(negative(z), r));
  const __m256 a = atan_unit(select(aside, z, r) / select(aside, r, z));
  const __m256 if_ahead = both(less(all(0), z), a);
  return select(ahead, if_ahead,
                select(aside, all(1.57079633f) - a, all(3.14159265f) + a));
}

struct Pixels {
  __m256 u, v, seen;
};

FASTLOOP_AVX2 Pixels project_fisheye(const CameraView& c, const Vector3x8& p) {
  const __m256 r = _mm256_sqrt_ps(p.x * p.x + p.y * p.y);
  const __m256 theta = axis_angle(r, p.z);
  const __m256 depth = _mm256_andnot_ps(all(-0.0f), p.z);
  const __m256 seen =
      both(less(theta, all(c.max_theta)), less(all(1e-9f), r + depth));
  const __m256 t2 = theta * theta;
  const __m256 theta_d =
      theta * (all(1.0f) +
               t2 * (all(c.k[0]) + t2 * (all(c.k[1]) + t2 * (all(c.k[2]) + t2 * all(c.k[3])))));
  const __m256 s = both(less(all(1e-12f), r), theta_d / r);
  return {all(c.fx) * (s * p.x) + all(c.cx), all(c.fy) * (s * p.y) + all(c.cy), seen};
}

FASTLOOP_AVX2 Pixels project_pinhole(const CameraView& c, const Vector3x8& p) {
  __m256 x = p.x / p.z, y = p.y / p.z;
  if (c.distorted) {
    const __m256 two = all(2.0f);
    const __m256 r2 = x * x + y * y;
    const __m256 radial =
        all(1.0f) + r2 * (all(c.k[0]) + r2 * (all(c.k[1]) + r2 * all(c.k[4])));
    const __m256 xy = x * y;
    const __m256 xd =
        x * radial + two * all(c.k[2]) * xy + all(c.k[3]) * (r2 + two * x * x);
    y = y * radial + all(c.k[2]) * (r2 + two * y * y) + two * all(c.k[3]) * xy;
    x = xd;
  }
  return {all(c.fx) * x + all(c.cx), all(c.fy) * y + all(c.cy), less(all(1e-9f), p.z)};
}

FASTLOOP_AVX2 Vector3x8 to_camera(const TargetView& t, const Vector3x8& ray) {
  const float* r = t.rotation;
  const auto row = [&](int i) __attribute__((target("avx2"), always_inline)) {
    return (all(r[i]) * ray.x + all(r[i + 1]) * ray.y + all(r[i + 2]) * ray.z) * all(t.scale);
  };
  return {row(0), row(3), row(6)};
}

__attribute__((target("avx2"))) unsigned sight8(const ProjectionRule& rule,
                                                const TargetView& target,
                                                const LandmarkArrays& landmarks, SightBatch* out) {
  const Vector3x8 p_world = load3(landmarks.p_world);
  const Vector3x8 ray{p_world.x - all(target.centre_world[0]),
                      p_world.y - all(target.centre_world[1]),
                      p_world.z - all(target.centre_world[2])};
  const Vector3x8 p = to_camera(target, ray);
  const Pixels pixels =
      rule.left.fisheye ? project_fisheye(rule.left, p) : project_pinhole(rule.left, p);
  const __m256 zero = all(0);
  __m256 pass = both(pixels.seen, both(at_most(zero, pixels.u), at_most(zero, pixels.v)));
  pass = both(pass, both(at_most(pixels.u, all(rule.left.max_x)),
                         at_most(pixels.v, all(rule.left.max_y))));
  if (_mm256_movemask_ps(pass) == 0) return 0;

  const __m256 distance = _mm256_sqrt_ps(ray.x * ray.x + ray.y * ray.y + ray.z * ray.z);
  const __m256 near = all(rule.min_distance_factor) * _mm256_loadu_ps(landmarks.min_distance_m);
  const __m256 max_distance = _mm256_loadu_ps(landmarks.max_distance_m);
  pass = both(pass, both(at_most(near, distance),
                         at_most(distance, all(rule.max_distance_factor) * max_distance)));
  __m256 dot = zero;
  if (needs_normal(rule)) {
    const Vector3x8 n = load3(landmarks.normal_world);
    dot = ray.x * n.x + ray.y * n.y + ray.z * n.z;
    if (rule.min_view_cos > -1.0f)
      pass = both(pass, at_most(all(rule.min_view_cos) * distance, dot));
  }
  const __m256 ratio = max_distance / distance;
  __m256i level = _mm256_setzero_si256();  // a comparison that holds is -1
  for (int l = 0; l < rule.scales.levels - 1; ++l)
    level = _mm256_sub_epi32(level, _mm256_castps_si256(less(all(rule.scales.scale[l]), ratio)));
  _mm256_store_si256(reinterpret_cast<__m256i*>(out->level), level);
  _mm256_store_ps(out->u, pixels.u);
  _mm256_store_ps(out->v, pixels.v);
  _mm256_store_ps(out->distance, distance);
  _mm256_store_ps(out->dot, dot);
  return static_cast<unsigned>(_mm256_movemask_ps(pass));
}

}  // namespace

bool can_sight_batches() {
  static const bool supported = __builtin_cpu_supports("avx2") != 0;
  return supported;
}

unsigned sight_batch(const ProjectionRule& rule, const TargetView& target,
                     const LandmarkArrays& landmarks, int first, int count, SightBatch* out) {
  constexpr int kLanes = SightBatch::kLanes;
  const std::size_t i = static_cast<std::size_t>(first);
  LandmarkArrays some{landmarks.p_world + 3 * i,
                      landmarks.normal_world ? landmarks.normal_world + 3 * i : nullptr,
                      landmarks.min_distance_m + i, landmarks.max_distance_m + i, nullptr};
  if (count == kLanes) return sight8(rule, target, some, out);
  // The last few are copied to where eight can be read.
  float p[3 * kLanes] = {}, n[3 * kLanes] = {}, near[kLanes] = {}, far[kLanes] = {};
  std::copy_n(some.p_world, 3 * count, p);
  if (some.normal_world) std::copy_n(some.normal_world, 3 * count, n);
  std::copy_n(some.min_distance_m, count, near);
  std::copy_n(some.max_distance_m, count, far);
  some = {p, n, near, far, nullptr};
  return sight8(rule, target, some, out) & ((1u << count) - 1u);
}

#else

bool can_sight_batches() {
  return false;
}

unsigned sight_batch(const ProjectionRule& rule, const TargetView& target,
                     const LandmarkArrays& landmarks, int first, int count, SightBatch* out) {
  unsigned passed = 0;
  for (int l = 0; l < count; ++l) {
    Sighting s;
    if (!sight(rule, target, landmarks, first + l, &s)) continue;
    out->u[l] = s.u;
    out->v[l] = s.v;
    out->distance[l] = s.distance;
    out->dot[l] = s.dot;
    out->level[l] = s.level;
    passed |= 1u << l;
  }
  return passed;
}

#endif

}  // namespace fastloop::matching
