#pragma once

#include <cstddef>

#include "fastloop/matching/camera_view.hpp"
#include "fastloop/matching/window_scan.hpp"

namespace fastloop::matching {

/// One target of the search as plain values: p_camera = scale * R * (p_world - centre_world).
/// Subtracting the centre first keeps float precision far from the origin.
struct TargetView {
  FeatureView features;
  float rotation[9];  ///< world to camera, row-major
  float centre_world[3];
  float scale;
  const std::uint8_t* landmark_skipped;  ///< null: none
};

/// Landmark arrays; vectors as three consecutive floats.
struct LandmarkArrays {
  const float *p_world, *normal_world;
  const float *min_distance_m, *max_distance_m;
  const Descriptor* descriptor;
};

/// Constants of one search.
struct ProjectionRule {
  CameraView left, right;
  float right_rotation[9], right_translation[3];  ///< left to right camera
  int rectified;         ///< the right coordinate follows from the baseline
  float focal_baseline;  ///< fx * baseline, pixels * metres
  int need_right;        ///< a gate uses the right pixel
  ScaleView scales;
  float radius_px;
  int max_distance;
  float min_view_cos, min_distance_factor, max_distance_factor;
  int octaves_below, octaves_above;
  float best_to_second, wide_view_cos, wide_factor;
  int check_right;
  float chi2_mono, chi2_stereo;
};

FASTLOOP_HD inline void rotate(const float r[9], const float p[3], float out[3]) {
  out[0] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2];
  out[1] = r[3] * p[0] + r[4] * p[1] + r[5] * p[2];
  out[2] = r[6] * p[0] + r[7] * p[1] + r[8] * p[2];
}

/// Smallest level whose scale reaches `ratio`: ceil(log(ratio) / log(factor)), clamped to the
/// pyramid.
FASTLOOP_HD inline int predicted_level(const ScaleView& scales, float ratio) {
  int level = 0;
  while (level < scales.levels - 1 && scales.scale[level] < ratio) ++level;
  return level;
}

FASTLOOP_HD inline void predict_right(const ProjectionRule& rule, const float p[3], WindowScan* w) {
  if (rule.rectified) {
    w->right_u = w->u - rule.focal_baseline / p[2];
    w->right_v = w->v;
    return;
  }
  float q[3];
  rotate(rule.right_rotation, p, q);
  for (int i = 0; i < 3; ++i) q[i] += rule.right_translation[i];
  if (!project(rule.right, q, &w->right_u, &w->right_v)) w->right_u = w->right_v = NAN;
}

/// Gates landmark `i` for a target and, where it passes, describes the window to search.
/// Comparisons are written so that NaN fails.
FASTLOOP_HD inline bool landmark_window(const ProjectionRule& rule, const TargetView& target,
                                        const LandmarkArrays& landmarks, int i, WindowScan* w) {
  const float* p_world = landmarks.p_world + 3 * static_cast<std::size_t>(i);
  const float ray[3] = {p_world[0] - target.centre_world[0], p_world[1] - target.centre_world[1],
                        p_world[2] - target.centre_world[2]};
  float p[3];
  rotate(target.rotation, ray, p);
  for (int k = 0; k < 3; ++k) p[k] *= target.scale;
  if (!project(rule.left, p, &w->u, &w->v) || !in_image(rule.left, w->u, w->v)) return false;

  const float distance = sqrtf(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
  const float far = landmarks.max_distance_m[i];
  if (!(distance >= rule.min_distance_factor * landmarks.min_distance_m[i]) ||
      !(distance <= rule.max_distance_factor * far))
    return false;

  w->radius = rule.radius_px;
  if (rule.min_view_cos > -1.0f || rule.wide_factor != 1.0f) {
    const float* n = landmarks.normal_world + 3 * static_cast<std::size_t>(i);
    const float dot = ray[0] * n[0] + ray[1] * n[1] + ray[2] * n[2];
    if (rule.min_view_cos > -1.0f && !(dot >= rule.min_view_cos * distance)) return false;
    if (dot < rule.wide_view_cos * distance) w->radius *= rule.wide_factor;
  }

  const int level = predicted_level(rule.scales, far / distance);
  w->radius *= rule.scales.scale[level];
  w->min_octave = level - rule.octaves_below;
  w->max_octave = level + rule.octaves_above;
  if (w->max_octave >= rule.scales.levels) w->max_octave = rule.scales.levels - 1;
  w->right_u = w->right_v = NAN;
  if (rule.need_right) predict_right(rule, p, w);
  w->right_radius = rule.check_right ? w->radius : -1.0f;
  w->use_right_v = !rule.rectified;
  w->chi2_mono = rule.chi2_mono;
  w->chi2_stereo = rule.chi2_stereo;
  w->max_distance = rule.max_distance;
  w->best_to_second = rule.best_to_second;
  return true;
}

/// The functor: one landmark in one target.
template <class Distances>
struct ProjectOne {
  ProjectionRule rule;
  LandmarkArrays landmarks;
  Distances distances;

  /// @param[out] in_view  passed every gate before the descriptor search
  FASTLOOP_HD MatchKey operator()(const TargetView& target, int i, std::uint8_t* in_view) const {
    *in_view = 0;
    if (target.landmark_skipped && target.landmark_skipped[i]) return kNoKey;
    WindowScan window;
    if (!landmark_window(rule, target, landmarks, i, &window)) return kNoKey;
    *in_view = 1;
    return scan_window(target.features, rule.scales, window, landmarks.descriptor[i], distances);
  }
};

}  // namespace fastloop::matching
