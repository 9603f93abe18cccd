#pragma once

#include <cstdint>

#include "fastloop/geometry/similarity_fit.hpp"
#include "fastloop/matching/camera_view.hpp"

/// The arithmetic of the similarity RANSAC, shared by host and device.
namespace fastloop::loop {

/// Camera of the second side: p_camera = rotation * p + translation.
struct ViewPose {
  float rotation[9], translation[3];
};

/// SimilarityPairs as raw pointers.
struct PairArrays {
  const float *p_first, *pixel_first, *gate_first;
  const float* p_second;
  const std::int32_t* view;
  const float *pixel_view, *gate_view;
  const ViewPose* views;
  int size;
  int num_views = 0;
};

FASTLOOP_HD inline bool reprojects(const matching::CameraView& camera, const float p[3],
                                   const float pixel[2], float gate) {
  float u, v;
  if (!matching::project(camera, p, &u, &v)) return false;
  const float du = u - pixel[0], dv = v - pixel[1];
  return du * du + dv * dv < gate;
}

FASTLOOP_HD inline bool is_inlier(const matching::CameraView& camera, const PairArrays& pairs,
                                  const SimilarityF& s, int i) {
  namespace d = similarity_fit_detail;
  float p[3], q[3];
  d::apply(s.rotation, pairs.p_second + 3 * i, p);
  for (int k = 0; k < 3; ++k) p[k] = s.scale * p[k] + s.translation[k];
  if (!reprojects(camera, p, pairs.pixel_first + 2 * i, pairs.gate_first[i])) return false;
  for (int k = 0; k < 3; ++k) p[k] = (pairs.p_first[3 * i + k] - s.translation[k]) / s.scale;
  for (int k = 0; k < 3; ++k)
    q[k] = s.rotation[k] * p[0] + s.rotation[3 + k] * p[1] + s.rotation[6 + k] * p[2];
  const ViewPose& view = pairs.views[pairs.view[i]];
  d::apply(view.rotation, q, p);
  for (int k = 0; k < 3; ++k) p[k] += view.translation[k];
  return reprojects(camera, p, pairs.pixel_view + 2 * i, pairs.gate_view[i]);
}

/// A well mixed 64-bit number from a counter (SplitMix64, Steele et al. 2014).
FASTLOOP_HD inline std::uint64_t mix(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

/// Three different indices below n (n >= 3), the same for the same seed and hypothesis.
FASTLOOP_HD inline void sample_three(std::uint64_t seed, int hypothesis, int n, int out[3]) {
  const std::uint64_t base = mix(seed) + 3u * static_cast<std::uint64_t>(hypothesis);
  const std::uint64_t count = static_cast<std::uint64_t>(n);
  out[0] = static_cast<int>(mix(base) % count);
  out[1] = static_cast<int>(mix(base + 1) % (count - 1));
  out[2] = static_cast<int>(mix(base + 2) % (count - 2));
  // Each is a place among the indices not yet taken.
  if (out[1] >= out[0]) ++out[1];
  const int low = out[0] < out[1] ? out[0] : out[1], high = out[0] < out[1] ? out[1] : out[0];
  if (out[2] >= low) ++out[2];
  if (out[2] >= high) ++out[2];
}

/// Hypothesis `h` of a problem; false when its sample is degenerate.
FASTLOOP_HD inline bool make_hypothesis(const PairArrays& pairs, std::uint64_t seed, int h,
                                        bool fixed_scale, SimilarityF* s) {
  int pick[3];
  sample_three(seed, h, pairs.size, pick);
  float first[9], second[9];
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) {
      first[3 * i + k] = pairs.p_first[3 * pick[i] + k];
      second[3 * i + k] = pairs.p_second[3 * pick[i] + k];
    }
  return fit_similarity(second, first, fixed_scale, s);
}

}  // namespace fastloop::loop
