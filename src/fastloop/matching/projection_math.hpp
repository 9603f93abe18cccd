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
/// pyramid. Scales ascend, so counting those below needs no branch.
FASTLOOP_HD inline int predicted_level(const ScaleView& scales, float ratio) {
  int level = 0;
  for (int l = 0; l < scales.levels - 1; ++l) level += scales.scale[l] < ratio;
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

/// A landmark that a target's camera can see.
struct Sighting {
  float u, v;      ///< pixel
  float distance;  ///< metres from the camera
  float dot;       ///< distance times the cosine of the viewing angle; 0 where nobody asks for it
  int level;       ///< of the pyramid, predicted
};

FASTLOOP_HD inline bool needs_normal(const ProjectionRule& rule) {
  return rule.min_view_cos > -1.0f || rule.wide_factor != 1.0f;
}

/// From the target's centre to the landmark, in the world.
FASTLOOP_HD inline void ray_to(const TargetView& target, const LandmarkArrays& landmarks, int i,
                               float ray[3]) {
  const float* p_world = landmarks.p_world + 3 * static_cast<std::size_t>(i);
  for (int k = 0; k < 3; ++k) ray[k] = p_world[k] - target.centre_world[k];
}

FASTLOOP_HD inline void to_camera(const TargetView& target, const float ray[3], float p[3]) {
  rotate(target.rotation, ray, p);
  for (int k = 0; k < 3; ++k) p[k] *= target.scale;
}

/// Gates of landmark `i` for a target. Comparisons are written so that NaN fails.
FASTLOOP_HD inline bool sight(const ProjectionRule& rule, const TargetView& target,
                              const LandmarkArrays& landmarks, int i, Sighting* s) {
  float ray[3], p[3];
  ray_to(target, landmarks, i, ray);
  to_camera(target, ray, p);
  if (!project(rule.left, p, &s->u, &s->v) || !in_image(rule.left, s->u, s->v)) return false;

  s->distance = sqrtf(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
  if (!(s->distance >= rule.min_distance_factor * landmarks.min_distance_m[i]) ||
      !(s->distance <= rule.max_distance_factor * landmarks.max_distance_m[i]))
    return false;

  s->level = predicted_level(rule.scales, landmarks.max_distance_m[i] / s->distance);
  s->dot = 0;
  if (!needs_normal(rule)) return true;
  const float* n = landmarks.normal_world + 3 * static_cast<std::size_t>(i);
  s->dot = ray[0] * n[0] + ray[1] * n[1] + ray[2] * n[2];
  return !(rule.min_view_cos > -1.0f) || s->dot >= rule.min_view_cos * s->distance;
}

/// The window in which landmark `i`, which passed the gates, is searched.
FASTLOOP_HD inline WindowScan window_of(const ProjectionRule& rule, const TargetView& target,
                                        const LandmarkArrays& landmarks, int i, const Sighting& s) {
  WindowScan w;
  w.u = s.u;
  w.v = s.v;
  w.radius = rule.radius_px;
  if (needs_normal(rule) && s.dot < rule.wide_view_cos * s.distance) w.radius *= rule.wide_factor;
  w.radius *= rule.scales.scale[s.level];
  w.min_octave = s.level - rule.octaves_below;
  w.max_octave = s.level + rule.octaves_above;
  if (w.max_octave >= rule.scales.levels) w.max_octave = rule.scales.levels - 1;
  w.right_u = w.right_v = NAN;
  if (rule.need_right) {
    float ray[3], p[3];
    ray_to(target, landmarks, i, ray);
    to_camera(target, ray, p);
    predict_right(rule, p, &w);
  }
  w.right_radius = rule.check_right ? w.radius : -1.0f;
  w.use_right_v = !rule.rectified;
  w.chi2_mono = rule.chi2_mono;
  w.chi2_stereo = rule.chi2_stereo;
  w.max_distance = rule.max_distance;
  w.best_to_second = rule.best_to_second;
  return w;
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
    Sighting sighting;
    if (!sight(rule, target, landmarks, i, &sighting)) return kNoKey;
    *in_view = 1;
    return search(target, i, sighting);
  }

  /// The search of a landmark that passed the gates.
  FASTLOOP_HD MatchKey search(const TargetView& target, int i, const Sighting& sighting) const {
    return scan_window(target.features, rule.scales, window_of(rule, target, landmarks, i, sighting),
                       landmarks.descriptor[i], distances);
  }
};

}  // namespace fastloop::matching
