#include <algorithm>
#include <cmath>

#include "fastloop/compute/executor.hpp"
#include "fastloop/features/hamming.hpp"
#include "fastloop/features/patch_alignment.hpp"
#include "fastloop/features/stereo_matching.hpp"

namespace fastloop {
namespace {

constexpr std::size_t kGrain = 64;  ///< keypoints worth a task
constexpr double kMinSine =
    0.1;  ///< of the angle to the baseline: along it no depth can be measured

/// Directions about the baseline: x from the left centre to the right one, z as near to the left
/// camera's as it gets.
///   plane  angle of the epipolar plane about the baseline
///   along  angle from the baseline within the plane, 0..pi; larger in the right view
class EpipolarFrame {
 public:
  explicit EpipolarFrame(const StereoRig& rig) {
    const Vector3d centre = rig.T_right_left.inverse().translation;
    baseline_ = centre.norm();
    const Vector3d x = centre / baseline_;
    const Vector3d forward = std::abs(x.z()) < 0.9 ? Vector3d::UnitZ() : Vector3d::UnitX();
    const Vector3d z = (forward - forward.dot(x) * x).normalized();
    R_epi_left_ << x.transpose(), z.cross(x).transpose(), z.transpose();
    R_epi_right_ = R_epi_left_ * rig.T_right_left.rotation.toRotationMatrix().transpose();
  }

  struct Angles {
    float plane = 0, along = 0, sine = 0;
  };
  Angles of_left(const Vector3d& ray) const { return angles(R_epi_left_ * ray); }
  Angles of_right(const Vector3d& ray) const { return angles(R_epi_right_ * ray); }

  /// Unit ray in the right camera.
  Vector3d right_ray(double plane, double along) const {
    const double s = std::sin(along);
    return R_epi_right_.transpose() *
           Vector3d(std::cos(along), s * std::sin(plane), s * std::cos(plane));
  }
  /// Distance from the left centre.
  double range(double left_along, double right_along) const {
    return baseline_ * std::sin(right_along) / std::sin(right_along - left_along);
  }

 private:
  static Angles angles(const Vector3d& v) {
    const double s = std::hypot(v.y(), v.z());
    return {static_cast<float>(std::atan2(v.y(), v.z())), static_cast<float>(std::atan2(s, v.x())),
            static_cast<float>(s)};
  }
  double baseline_ = 0;
  Matrix3d R_epi_left_, R_epi_right_;
};

/// The right keypoints sorted by epipolar plane.
struct PlaneTable {
  std::vector<float> plane;             ///< ascending
  std::vector<std::uint16_t> keypoint;  ///< index of each
};

class GeneralMatcher {
 public:
  GeneralMatcher(const StereoRig& rig, const PyramidScales& scales, const StereoView& left,
                 const StereoView& right, const StereoMatchOptions& options)
      : rig_(rig), scales_(scales), left_(left), right_(right), options_(options), epipolar_(rig) {
    compute_angles();
    build_table();
  }

  void run(FeatureSet& frame) const;

 private:
  using Angles = EpipolarFrame::Angles;
  void compute_angles();
  void build_table();
  float plane_tolerance(const Angles& a, int octave) const {
    return options_.row_tolerance_px * scales_.scale[octave] /
           (static_cast<float>(rig_.left.fx) * a.sine);
  }
  bool compatible(std::size_t i, std::size_t j) const;
  void candidates_of(std::size_t i, std::vector<std::uint16_t>& candidates) const;
  void refine(std::size_t i, std::size_t j, FeatureSet& frame) const;

  const StereoRig& rig_;
  const PyramidScales& scales_;
  const StereoView left_, right_;
  const StereoMatchOptions& options_;
  EpipolarFrame epipolar_;
  std::vector<Vector3d> left_rays_;
  std::vector<Angles> left_angles_, right_angles_;
  PlaneTable table_;
};

void GeneralMatcher::compute_angles() {
  const OrbFeatures& l = left_.features;
  const OrbFeatures& r = right_.features;
  left_rays_.resize(l.size());
  left_angles_.resize(l.size());
  right_angles_.resize(r.size());
  Executor::cpu().for_ranges(
      l.size() + r.size(), 2 * kGrain, [&](std::size_t begin, std::size_t end) {
        for (std::size_t k = begin; k < end; ++k) {
          if (k < l.size()) {
            left_rays_[k] = rig_.left.unproject({l.x[k], l.y[k]});
            left_angles_[k] = epipolar_.of_left(left_rays_[k]);
          } else {
            const std::size_t j = k - l.size();
            right_angles_[j] = epipolar_.of_right(rig_.right.unproject({r.x[j], r.y[j]}));
          }
        }
      });
}

void GeneralMatcher::build_table() {
  table_.keypoint.resize(right_angles_.size());
  for (std::size_t j = 0; j < right_angles_.size(); ++j)
    table_.keypoint[j] = static_cast<std::uint16_t>(j);
  std::sort(table_.keypoint.begin(), table_.keypoint.end(), [&](auto a, auto b) {
    return std::pair(right_angles_[a].plane, a) < std::pair(right_angles_[b].plane, b);
  });
  for (const std::uint16_t j : table_.keypoint) table_.plane.push_back(right_angles_[j].plane);
}

bool GeneralMatcher::compatible(std::size_t i, std::size_t j) const {
  const Angles &a = left_angles_[i], &b = right_angles_[j];
  const int octave = right_.features.octave[j];
  if (std::abs(left_.features.octave[i] - octave) > 1 || b.sine < kMinSine) return false;
  const float slack =
      options_.row_tolerance_px * scales_.scale[octave] / static_cast<float>(rig_.left.fx);
  const float parallax = b.along - a.along;
  return std::abs(a.plane - b.plane) <= plane_tolerance(b, octave) && parallax >= -slack &&
         parallax <= options_.max_parallax_rad;
}

void GeneralMatcher::candidates_of(std::size_t i, std::vector<std::uint16_t>& candidates) const {
  candidates.clear();
  const Angles& a = left_angles_[i];
  if (a.sine < kMinSine) return;
  const int top = std::min<int>(left_.features.octave[i] + 1, scales_.levels - 1);
  // Within the plane the sine changes with the parallax; twice the tolerance covers that.
  const float reach = 2 * plane_tolerance(a, top);
  const auto first = std::lower_bound(table_.plane.begin(), table_.plane.end(), a.plane - reach);
  for (auto k = static_cast<std::size_t>(first - table_.plane.begin());
       k < table_.plane.size() && table_.plane[k] <= a.plane + reach; ++k)
    if (compatible(i, table_.keypoint[k])) candidates.push_back(table_.keypoint[k]);
  std::sort(candidates.begin(), candidates.end());
}

/// Finds left patch i near right keypoint j on the epipolar curve of i, and triangulates.
void GeneralMatcher::refine(std::size_t i, std::size_t j, FeatureSet& frame) const {
  const OrbFeatures& l = left_.features;
  const int octave = l.octave[i];
  const LevelScale scale(left_.pyramid, octave);
  const int x = static_cast<int>(std::lround(scale.to_level_x(l.x[i])));
  const int y = static_cast<int>(std::lround(scale.to_level_y(l.y[i])));
  const Angles& a = left_angles_[i];
  const double along =
      std::max<double>(right_angles_[j].along, a.along + options_.min_parallax_rad);
  const double range = epipolar_.range(a.along, along);

  const auto right_pixel = [&](double at) {
    return rig_.right.project(epipolar_.right_ray(a.plane, at));
  };
  const Eigen::Vector2d start = right_pixel(along);
  constexpr double kStepRad = 1e-3;
  const Eigen::Vector2d tangent =
      (right_pixel(along + kStepRad) - start) / kStepRad;  // pixels / rad
  const double speed = tangent.norm();
  if (!(speed > 1) || !rig_.right.contains(start)) return;
  const Eigen::Vector2d direction = tangent / speed;

  // How the patch is distorted on its way to the right image, were the scene a sphere about the
  // left camera.
  const double step_px = 4 * scale.x;
  Eigen::Matrix2d warp;
  for (int axis = 0; axis < 2; ++axis) {
    Eigen::Vector2d pixel(l.x[i], l.y[i]);
    pixel(axis) += step_px;
    const Vector3d p_right = rig_.T_right_left * (range * rig_.left.unproject(pixel));
    warp.col(axis) = (rig_.right.project(p_right) - start) / step_px;
  }
  if (!warp.allFinite() || warp.determinant() < 0.25) return;
  const Eigen::Vector2d seen_left = warp.inverse() * direction;
  const ImageU8& left_level = left_.pyramid.levels[octave];
  const PatchTemplate patch(left_level, x, y, static_cast<float>(seen_left.x()),
                            static_cast<float>(seen_left.y()));
  const auto f = [](double v) { return static_cast<float>(v); };
  // The patch is centred on a whole pixel; the line goes through the match of the keypoint itself.
  const Eigen::Vector2d to_patch(x - scale.to_level_x(l.x[i]), y - scale.to_level_y(l.y[i]));
  const Eigen::Vector2d centre =
      Eigen::Vector2d(scale.to_level_x(f(start.x())), scale.to_level_y(f(start.y()))) +
      warp * to_patch;
  const PatchLine line{f(centre.x()),
                       f(centre.y()),
                       f(direction.x()),
                       f(direction.y()),
                       {f(warp(0, 0)), f(warp(0, 1)), f(warp(1, 0)), f(warp(1, 1))}};
  const PatchFit fit = align_along_line(patch, right_.pyramid.levels[octave], line,
                                        static_cast<float>(options_.search_px));
  if (!fit.converged || fit.correlation < options_.min_correlation) return;

  const double refined = along + fit.shift_px * scale.x / speed;
  const double parallax = refined - a.along;
  if (!(parallax >= options_.min_parallax_rad && parallax <= options_.max_parallax_rad)) return;
  const double depth = epipolar_.range(a.along, refined) * left_rays_[i].z();
  const Eigen::Vector2d pixel = right_pixel(refined);
  if (!(depth > 0) || !rig_.right.contains(pixel)) return;
  frame.right_x[i] = f(pixel.x());
  frame.right_y[i] = f(pixel.y());
  frame.depth_m[i] = f(depth);
}

void GeneralMatcher::run(FeatureSet& frame) const {
  const OrbFeatures& l = left_.features;
  const OrbFeatures& r = right_.features;
  std::vector<std::int32_t> match(l.size(), -1);
  std::vector<std::int32_t> distance(l.size(), NearestDescriptor::kNoDistance);
  Executor::cpu().for_ranges(l.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    std::vector<std::uint16_t> candidates;
    for (std::size_t i = begin; i < end; ++i) {
      candidates_of(i, candidates);
      const NearestDescriptor best =
          nearest_descriptor(l.descriptors[i], r.descriptors.data(), candidates);
      if (best.distance >= options_.max_distance) continue;
      if (static_cast<float>(best.distance) >
          options_.best_to_second * static_cast<float>(best.second_distance))
        continue;
      match[i] = candidates[best.position];
      distance[i] = best.distance;
    }
  });
  // Of several left keypoints that claim one right keypoint the nearest keeps it; ties: the lower
  // index.
  std::vector<std::int32_t> claimed(r.size(), -1);
  for (std::size_t i = 0; i < l.size(); ++i) {
    if (match[i] < 0) continue;
    auto& holder = claimed[match[i]];
    if (holder < 0 || distance[i] < distance[holder]) holder = static_cast<std::int32_t>(i);
  }
  Executor::cpu().for_ranges(r.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    for (std::size_t j = begin; j < end; ++j)
      if (claimed[j] >= 0) refine(claimed[j], j, frame);
  });
}

}  // namespace

void match_general(const StereoRig& rig, const PyramidScales& scales, const StereoView& left,
                   const StereoView& right, const StereoMatchOptions& options, FeatureSet& frame) {
  GeneralMatcher(rig, scales, left, right, options).run(frame);
}

}  // namespace fastloop
