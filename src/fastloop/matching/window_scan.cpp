#include "fastloop/matching/window_scan.hpp"

#include "fastloop/core/error.hpp"

namespace fastloop::matching {

FeatureView make_feature_view(const FeatureSet& features, std::span<const std::uint8_t> blocked) {
  const std::size_t n = features.size();
  if (!blocked.empty() && blocked.size() != n)
    throw InvalidArgument("matching: keypoint_blocked must have one entry per keypoint");
  if (features.y.size() != n || features.octave.size() != n || features.descriptors.size() != n ||
      features.right_x.size() != n || features.right_y.size() != n)
    throw InvalidArgument("matching: arrays of a feature set differ in length");
  if (n > 0 && (features.grid.start.size() != KeypointGrid::kCols * KeypointGrid::kRows + 1 ||
                features.grid.indices.size() != n))
    throw InvalidArgument("matching: the grid of a feature set does not match its keypoints");
  FeatureView view;
  view.x = features.x.data();
  view.y = features.y.data();
  view.right_x = features.right_x.data();
  view.right_y = features.right_y.data();
  view.octave = features.octave.data();
  view.descriptors = features.descriptors.data();
  view.cell_start = features.grid.start.data();
  view.cell_indices = features.grid.indices.data();
  view.blocked = blocked.empty() ? nullptr : blocked.data();
  view.cell_width_px = features.grid.cell_width_px;
  view.cell_height_px = features.grid.cell_height_px;
  view.size = static_cast<int>(n);
  return view;
}

}  // namespace fastloop::matching
