#include "fastloop/matching/packed_features.hpp"

#include <algorithm>
#include <cstring>

namespace fastloop::matching {

void pack_features(const FeatureSet& features, std::byte* out) {
  const FeatureView f = make_feature_view(features, {});
  const auto n = static_cast<std::size_t>(f.size);
  const PackedView packed = packed_view(out, f.size, f.cell_width_px, f.cell_height_px);
  auto* keypoints = const_cast<PackedKeypoint*>(packed.keypoints);
  auto* descriptors = const_cast<Descriptor*>(packed.descriptors);
  auto* position = const_cast<std::uint16_t*>(packed.position);
  auto* right_y = const_cast<float*>(packed.right_y);
  for (std::size_t i = 0; i < n; ++i) {
    const std::uint16_t k = f.cell_indices[i];
    keypoints[i] = {f.x[k], f.y[k], f.right_x[k], std::uint32_t{f.octave[k]} << 16 | k};
    descriptors[i] = f.descriptors[k];
    right_y[i] = f.right_y[k];
    position[k] = static_cast<std::uint16_t>(i);
  }
  auto* start = const_cast<std::uint16_t*>(packed.cell_start);
  if (n == 0)
    std::fill_n(start, kPackedCells + 1, std::uint16_t{0});
  else
    std::transform(f.cell_start, f.cell_start + kPackedCells + 1, start,
                   [](std::uint32_t s) { return static_cast<std::uint16_t>(s); });
}

void pack_landmarks(const LandmarkArrays& landmarks, std::size_t n, std::byte* out) {
  const LandmarkArrays to = packed_landmarks(out, n);
  const auto copy = [n](const auto* from, const auto* target, std::size_t per_landmark) {
    if (from && n > 0)
      std::memcpy(const_cast<void*>(static_cast<const void*>(target)), from,
                  n * per_landmark * sizeof(*from));
  };
  copy(landmarks.descriptor, to.descriptor, 1);
  copy(landmarks.p_world, to.p_world, 3);
  copy(landmarks.normal_world, to.normal_world, 3);
  copy(landmarks.min_distance_m, to.min_distance_m, 1);
  copy(landmarks.max_distance_m, to.max_distance_m, 1);
}

}  // namespace fastloop::matching
