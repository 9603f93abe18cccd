#include "fastloop/matching/packed_features.hpp"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

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
  const auto copy = [](const auto* from, const auto* target, std::size_t per_landmark,
                       std::size_t begin, std::size_t end) {
    if (from)
      std::memcpy(const_cast<void*>(static_cast<const void*>(target + begin * per_landmark)),
                  from + begin * per_landmark, (end - begin) * per_landmark * sizeof(*from));
  };
  const auto copy_range = [&](std::size_t begin, std::size_t end) {
    copy(landmarks.descriptor, to.descriptor, 1, begin, end);
    copy(landmarks.p_world, to.p_world, 3, begin, end);
    copy(landmarks.normal_world, to.normal_world, 3, begin, end);
    copy(landmarks.min_distance_m, to.min_distance_m, 1, begin, end);
    copy(landmarks.max_distance_m, to.max_distance_m, 1, begin, end);
  };
  constexpr std::size_t kShare = 2048;  // worth a task
  if (n <= 2 * kShare) {
    if (n > 0) copy_range(0, n);
    return;
  }
  // Callers hold a mutex, and so this thread must not begin somebody else's task meanwhile.
  tbb::this_task_arena::isolate([&] {
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, n, kShare), [&](const auto& range) {
      copy_range(range.begin(), range.end());
    });
  });
}

}  // namespace fastloop::matching
