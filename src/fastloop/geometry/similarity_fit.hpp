#pragma once

#include <cmath>

#include "fastloop/compute/host_device.hpp"

namespace fastloop {

/// A similarity as plain floats, row-major: b = scale * R * a + t.
struct SimilarityF {
  float rotation[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  float translation[3] = {0, 0, 0};
  float scale = 1;
};

namespace similarity_fit_detail {

FASTLOOP_HD inline void cross(const float a[3], const float b[3], float out[3]) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}
FASTLOOP_HD inline float dot(const float a[3], const float b[3]) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/// Unit normal of a triangle given by points about its centroid; false when its corners lie on a
/// line.
FASTLOOP_HD inline bool normal_of(const float p[9], float n[3]) {
  float e1[3], e2[3];
  for (int k = 0; k < 3; ++k) {
    e1[k] = p[3 + k] - p[k];
    e2[k] = p[6 + k] - p[k];
  }
  cross(e1, e2, n);
  const float area_sq = dot(n, n);
  if (!(area_sq > 1e-6f * dot(e1, e1) * dot(e2, e2)) || !(area_sq > 1e-20f)) return false;
  const float inverse = 1.0f / sqrtf(area_sq);
  for (int k = 0; k < 3; ++k) n[k] *= inverse;
  return true;
}

/// Rotation that takes unit vector `from` to unit vector `to`; `across` is any unit vector orthogonal
/// to `from`. Vectors more than a right angle apart are turned over about `across` first, so that
/// nothing is divided by a small number.
FASTLOOP_HD inline void rotation_between(const float from[3], const float to[3],
                                         const float across[3], float r[9]) {
  const bool turn_over = dot(from, to) < 0;
  const float sign = turn_over ? -1.0f : 1.0f;
  const float a[3] = {sign * from[0], sign * from[1], sign * from[2]};
  const float c = dot(a, to);
  float v[3], s[9];
  cross(a, to, v);
  const float k = 1.0f / (1.0f + c);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) s[3 * i + j] = k * v[i] * v[j] + (i == j ? c : 0.0f);
  s[1] -= v[2];
  s[2] += v[1];
  s[3] += v[2];
  s[5] -= v[0];
  s[6] -= v[1];
  s[7] += v[0];
  for (int i = 0; i < 3; ++i) {
    // s * (2 across across^T - 1) when turned over, s otherwise.
    const float along = s[3 * i] * across[0] + s[3 * i + 1] * across[1] + s[3 * i + 2] * across[2];
    for (int j = 0; j < 3; ++j)
      r[3 * i + j] = turn_over ? 2.0f * along * across[j] - s[3 * i + j] : s[3 * i + j];
  }
}

FASTLOOP_HD inline void apply(const float r[9], const float p[3], float out[3]) {
  out[0] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2];
  out[1] = r[3] * p[0] + r[4] * p[1] + r[5] * p[2];
  out[2] = r[6] * p[0] + r[7] * p[1] + r[8] * p[2];
}

}  // namespace similarity_fit_detail

/// The similarity that takes three points `a` to three points `b` with least squared error, in
/// closed form: planes onto each other, then the best turn within the plane (Horn, JOSA A 1987,
/// section 5). Square roots and quotients only, so that host and device give the same bits.
///
/// @param a, b          three points each, xyz xyz xyz
/// @param fixed_scale   true: scale is 1
/// @return false when either triangle is degenerate; then `out` is not written
FASTLOOP_HD inline bool fit_similarity(const float a[9], const float b[9], bool fixed_scale,
                                       SimilarityF* out) {
  namespace d = similarity_fit_detail;
  float centre_a[3], centre_b[3], pa[9], pb[9];
  for (int k = 0; k < 3; ++k) {
    centre_a[k] = (a[k] + a[3 + k] + a[6 + k]) / 3.0f;
    centre_b[k] = (b[k] + b[3 + k] + b[6 + k]) / 3.0f;
  }
  for (int i = 0; i < 9; ++i) {
    pa[i] = a[i] - centre_a[i % 3];
    pb[i] = b[i] - centre_b[i % 3];
  }
  float normal_a[3], normal_b[3];
  if (!d::normal_of(pa, normal_a) || !d::normal_of(pb, normal_b)) return false;
  float edge[3], flat[9];
  const float edge_sq =
      (pa[3] - pa[0]) * (pa[3] - pa[0]) + (pa[4] - pa[1]) * (pa[4] - pa[1]) +
      (pa[5] - pa[2]) * (pa[5] - pa[2]);
  for (int k = 0; k < 3; ++k) edge[k] = (pa[3 + k] - pa[k]) / sqrtf(edge_sq);
  d::rotation_between(normal_a, normal_b, edge, flat);

  float along = 0, across = 0, size_a = 0, size_b = 0;
  for (int i = 0; i < 3; ++i) {
    float turned[3], side[3];
    d::apply(flat, pa + 3 * i, turned);
    d::cross(turned, pb + 3 * i, side);
    along += d::dot(turned, pb + 3 * i);
    across += d::dot(side, normal_b);
    size_a += d::dot(pa + 3 * i, pa + 3 * i);
    size_b += d::dot(pb + 3 * i, pb + 3 * i);
  }
  const float length = sqrtf(along * along + across * across);
  if (!(length > 0.0f)) return false;
  const float c = along / length, s = across / length;
  const float* n = normal_b;
  const float turn[9] = {c + (1 - c) * n[0] * n[0],        (1 - c) * n[0] * n[1] - s * n[2],
                         (1 - c) * n[0] * n[2] + s * n[1], (1 - c) * n[0] * n[1] + s * n[2],
                         c + (1 - c) * n[1] * n[1],        (1 - c) * n[1] * n[2] - s * n[0],
                         (1 - c) * n[0] * n[2] - s * n[1], (1 - c) * n[1] * n[2] + s * n[0],
                         c + (1 - c) * n[2] * n[2]};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out->rotation[3 * i + j] = turn[3 * i] * flat[j] + turn[3 * i + 1] * flat[3 + j] +
                                 turn[3 * i + 2] * flat[6 + j];
  out->scale = fixed_scale ? 1.0f : sqrtf(size_b / size_a);
  float moved[3];
  d::apply(out->rotation, centre_a, moved);
  for (int k = 0; k < 3; ++k) out->translation[k] = centre_b[k] - out->scale * moved[k];
  return true;
}

}  // namespace fastloop
