#include <cmath>

#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/claims.hpp"
#include "fastloop/matching/projection_search.hpp"
#include "fastloop/matching/rotation_histogram.hpp"

namespace fastloop::matching {
namespace {

constexpr std::size_t kGrain = 128;  // queries worth a task

WindowScan make_window(const WindowQuery& query, const WindowSearchOptions& options) {
  WindowScan w{};
  w.u = query.pixel.x();
  w.v = query.pixel.y();
  w.radius = query.radius_px;
  w.min_octave = query.min_octave;
  w.max_octave = query.max_octave;
  w.right_u = query.right_x;
  w.right_radius = std::isnan(query.right_x) ? -1.0f : query.radius_px;
  w.max_distance = options.max_distance;
  w.best_to_second = options.best_to_second;
  return w;
}

template <class Distances>
void search_all(const Executor& executor, const FeatureView& view,
                std::span<const WindowQuery> queries, const WindowSearchOptions& options,
                std::vector<MatchKey>& keys) {
  const ScaleView no_scales{};  // only the reprojection gates use them
  executor.for_ranges(queries.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i)
      keys[i] = scan_window(view, no_scales, make_window(queries[i], options),
                            queries[i].descriptor, Distances{});
  });
}

}  // namespace

std::vector<std::int32_t> search_windows(const Executor& executor, const FeatureSet& features,
                                         std::span<const WindowQuery> queries,
                                         const WindowSearchOptions& options,
                                         std::span<const std::uint8_t> keypoint_blocked) {
  const FeatureView view = make_feature_view(features, keypoint_blocked);
  std::vector<MatchKey> keys(queries.size(), kNoKey);
  if (executor.kind() == Executor::Kind::kReference)
    search_all<PortableDistances>(executor, view, queries, options, keys);
  else
    search_all<CpuDistances>(executor, view, queries, options, keys);
  std::vector<std::int32_t> matches(queries.size());
  resolve_claims(keys, features.size(), matches, {});
  if (options.check_rotation) {
    std::vector<float> angles(queries.size());
    for (std::size_t i = 0; i < queries.size(); ++i) angles[i] = queries[i].angle_rad;
    drop_odd_rotations(angles, features.angle_rad, matches);
  }
  return matches;
}

}  // namespace fastloop::matching
