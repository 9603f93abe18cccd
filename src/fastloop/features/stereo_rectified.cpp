#include <algorithm>
#include <cmath>
#include <limits>

#include "fastloop/compute/executor.hpp"
#include "fastloop/features/hamming.hpp"
#include "fastloop/features/patch_alignment.hpp"
#include "fastloop/features/stereo_matching.hpp"

namespace fastloop {
namespace {

constexpr std::size_t kGrain = 64;  ///< keypoints worth a task

/// Right keypoints by image row: row r lists those within their tolerance of it, ascending.
class RowTable {
 public:
  RowTable(const OrbFeatures& right, const PyramidScales& scales, float tolerance_px, int rows)
      : start_(rows + 1, 0) {
    const auto band = [&](std::size_t i) {
      const float r = tolerance_px * scales.scale[right.octave[i]];
      return std::pair{std::max(0, static_cast<int>(std::ceil(right.y[i] - r))),
                       std::min(rows - 1, static_cast<int>(std::floor(right.y[i] + r)))};
    };
    for (std::size_t i = 0; i < right.size(); ++i) {
      const auto [first, last] = band(i);
      for (int row = first; row <= last; ++row) ++start_[row + 1];
    }
    for (int row = 0; row < rows; ++row) start_[row + 1] += start_[row];
    entries_.resize(start_.back());
    std::vector<std::uint32_t> next(start_.begin(), start_.end() - 1);
    for (std::size_t i = 0; i < right.size(); ++i) {
      const auto [first, last] = band(i);
      for (int row = first; row <= last; ++row)
        entries_[next[row]++] = static_cast<std::uint16_t>(i);
    }
  }

  std::span<const std::uint16_t> row(int r) const {
    if (r < 0 || r + 1 >= static_cast<int>(start_.size())) return {};
    return std::span(entries_).subspan(start_[r], start_[r + 1] - start_[r]);
  }

 private:
  std::vector<std::uint32_t> start_;
  std::vector<std::uint16_t> entries_;
};

/// Right column of left keypoint i at sub-pixel precision, from the right keypoint matched to it;
/// NaN when the images disagree.
float refine_column(const StereoView& left, const StereoView& right, std::size_t i, float right_x,
                    const StereoMatchOptions& options) {
  constexpr float kNone = std::numeric_limits<float>::quiet_NaN();
  const int octave = left.features.octave[i];
  const ImageU8& left_level = left.pyramid.levels[octave];
  const ImageU8& right_level = right.pyramid.levels[octave];
  const LevelScale scale(left.pyramid, octave);
  const int x = static_cast<int>(std::lround(scale.to_level_x(left.features.x[i])));
  const int y = static_cast<int>(std::lround(scale.to_level_y(left.features.y[i])));
  const PatchTemplate patch(left_level, x, y, 1, 0);
  const int start = static_cast<int>(std::lround(scale.to_level_x(right_x)));
  const PatchFit fit = align_along_row(patch, right_level, start, y, options.search_px);
  if (!fit.converged || fit.correlation < options.min_correlation) return kNone;
  // The patch is centred on a whole pixel; the keypoint keeps its distance from it.
  const float offset = left.features.x[i] - scale.to_base_x(static_cast<float>(x));
  return scale.to_base_x(static_cast<float>(start) + fit.shift_px) + offset;
}

}  // namespace

void match_rectified(const StereoRig& rig, const PyramidScales& scales, const StereoView& left,
                     const StereoView& right, const StereoMatchOptions& options,
                     FeatureSet& frame) {
  const OrbFeatures& l = left.features;
  const OrbFeatures& r = right.features;
  const RowTable table(r, scales, options.row_tolerance_px, rig.left.height);
  // Nothing nearer than the baseline.
  const float max_disparity = static_cast<float>(rig.left.fx);
  const float focal_baseline = static_cast<float>(rig.left.fx * rig.baseline_m);

  Executor::cpu().for_ranges(l.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    std::vector<std::uint16_t> candidates;
    for (std::size_t i = begin; i < end; ++i) {
      candidates.clear();
      for (const std::uint16_t j : table.row(static_cast<int>(std::lround(l.y[i])))) {
        // A keypoint seen at infinity may be found a little to the right of its place.
        const float disparity = l.x[i] - r.x[j];
        if (std::abs(l.octave[i] - r.octave[j]) <= 1 && disparity <= max_disparity &&
            disparity >= -scales.scale[l.octave[i]])
          candidates.push_back(j);
      }
      const NearestDescriptor best =
          nearest_descriptor(l.descriptors[i], r.descriptors.data(), candidates);
      if (best.distance >= options.max_distance) continue;
      const float x = refine_column(left, right, i, r.x[candidates[best.position]], options);
      const float disparity = l.x[i] - x;
      if (!(disparity >= options.min_disparity_px && disparity <= max_disparity)) continue;
      frame.right_x[i] = x;
      frame.right_y[i] = l.y[i];
      frame.depth_m[i] = focal_baseline / disparity;
    }
  });
}

}  // namespace fastloop
