#include "fastloop/matching/projection_search.hpp"

#include <algorithm>
#include <bit>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/claims.hpp"
#include "fastloop/matching/ordered_scan.hpp"
#include "fastloop/matching/projection_math.hpp"
#include "fastloop/matching/sight_batch.hpp"

namespace fastloop::matching {
namespace {

constexpr std::size_t kGrain = 256;  // landmarks worth a task

void require(bool condition, const char* message) {
  if (!condition) throw InvalidArgument(std::string("search_by_projection: ") + message);
}

void check_arguments(const PyramidScales& scales, std::span<const SearchTarget> targets,
                     const LandmarkView& landmarks, const ProjectionSearchOptions& options,
                     std::span<ProjectionMatches> results) {
  const std::size_t n = landmarks.size();
  const bool needs_normals = options.min_view_cos > -1 || options.wide_factor != 1;
  require(results.size() == targets.size(), "one result per target");
  require(landmarks.min_distance_m.size() == n && landmarks.max_distance_m.size() == n &&
              landmarks.descriptor.size() == n,
          "landmark arrays differ in length");
  require(landmarks.normal_world.size() == n || (landmarks.normal_world.empty() && !needs_normals),
          "landmark normals differ in length");
  require(scales.levels > 0 && scales.scale.size() == static_cast<std::size_t>(scales.levels) &&
              scales.sigma2.size() == scales.scale.size(),
          "incomplete pyramid scales");
  for (const SearchTarget& target : targets) {
    require(target.features != nullptr, "a target has no features");
    require(target.landmark_skipped.empty() || target.landmark_skipped.size() == n,
            "landmark_skipped must have one entry per landmark");
  }
}

void store_row_major(const Eigen::Quaterniond& q, float out[9]) {
  const Matrix3d r = q.toRotationMatrix();
  for (int row = 0; row < 3; ++row)
    for (int col = 0; col < 3; ++col) out[3 * row + col] = static_cast<float>(r(row, col));
}

TargetView make_target_view(const SearchTarget& target) {
  TargetView view;
  view.features = make_feature_view(*target.features, target.keypoint_blocked);
  store_row_major(target.T_camera_world.rotation, view.rotation);
  const Vector3d centre = target.T_camera_world.inverse().translation;
  for (int i = 0; i < 3; ++i) view.centre_world[i] = static_cast<float>(centre[i]);
  view.scale = static_cast<float>(target.scale);
  view.landmark_skipped =
      target.landmark_skipped.empty() ? nullptr : target.landmark_skipped.data();
  return view;
}

ProjectionRule make_rule(const StereoRig& rig, const PyramidScales& scales,
                         const ProjectionSearchOptions& o) {
  ProjectionRule rule;
  rule.left = make_camera_view(rig.left);
  rule.right = make_camera_view(rig.right);
  store_row_major(rig.T_right_left.rotation, rule.right_rotation);
  for (int i = 0; i < 3; ++i)
    rule.right_translation[i] = static_cast<float>(rig.T_right_left.translation[i]);
  rule.rectified = rig.kind == StereoRig::Kind::kRectified;
  rule.focal_baseline = static_cast<float>(rig.left.fx * rig.baseline_m);
  rule.need_right = o.check_right || o.chi2_gate_stereo > 0;
  rule.scales = {scales.scale.data(), scales.sigma2.data(), scales.levels};
  rule.radius_px = o.radius_px;
  rule.max_distance = o.max_distance;
  rule.min_view_cos = o.min_view_cos;
  rule.min_distance_factor = o.min_distance_factor;
  rule.max_distance_factor = o.max_distance_factor;
  rule.octaves_below = o.octaves_below;
  rule.octaves_above = o.octaves_above;
  rule.best_to_second = o.best_to_second;
  rule.wide_view_cos = o.wide_view_cos;
  rule.wide_factor = o.wide_factor;
  rule.check_right = o.check_right;
  rule.chi2_mono = o.chi2_gate_mono;
  rule.chi2_stereo = o.chi2_gate_stereo;
  return rule;
}

LandmarkArrays make_arrays(const LandmarkView& landmarks) {
  static_assert(sizeof(Eigen::Vector3f) == 3 * sizeof(float));
  return {reinterpret_cast<const float*>(landmarks.p_world.data()),
          reinterpret_cast<const float*>(landmarks.normal_world.data()),
          landmarks.min_distance_m.data(), landmarks.max_distance_m.data(),
          landmarks.descriptor.data()};
}

/// Landmarks [begin, end) of target t, one after another.
template <class Distances>
struct ScalarSearch {
  ProjectOne<Distances> one;
  std::span<const TargetView> targets;

  void operator()(std::size_t t, std::size_t begin, std::size_t end, MatchKey* keys,
                  std::uint8_t* in_view) const {
    for (std::size_t i = begin; i < end; ++i)
      keys[i] = one(targets[t], static_cast<int>(i), &in_view[i]);
  }
};

/// The same with the gates of several landmarks, where most end, and several keypoints at a time.
struct VectorSearch {
  ProjectionRule rule;
  LandmarkArrays landmarks;
  std::span<const TargetView> targets;
  std::vector<OrderedKeypoints> keypoints;  ///< [targets]

  void operator()(std::size_t t, std::size_t begin, std::size_t end, MatchKey* keys,
                  std::uint8_t* in_view) const {
    const TargetView& target = targets[t];
    std::fill(keys + begin, keys + end, kNoKey);
    std::fill(in_view + begin, in_view + end, std::uint8_t{0});
    SightBatch batch;
    for (std::size_t first = begin; first < end; first += SightBatch::kLanes) {
      const auto count = std::min<std::size_t>(SightBatch::kLanes, end - first);
      unsigned passed = sight_batch(rule, target, landmarks, static_cast<int>(first),
                                    static_cast<int>(count), &batch);
      for (; passed != 0; passed &= passed - 1) {
        const int lane = std::countr_zero(passed);
        const std::size_t i = first + static_cast<std::size_t>(lane);
        if (target.landmark_skipped && target.landmark_skipped[i]) continue;
        in_view[i] = 1;
        const WindowScan window =
            window_of(rule, target, landmarks, static_cast<int>(i), batch.lane(lane));
        keys[i] = keypoints[t].scan(rule.scales, window, landmarks.descriptor[i]);
      }
    }
  }
};

/// Every (target, landmark) pair writes its own element of `keys` and `in_view`: no order matters.
template <class Search>
void search_all(const Executor& executor, const Search& search, std::size_t num_landmarks,
                std::vector<std::vector<MatchKey>>& keys, std::span<ProjectionMatches> results) {
  const std::size_t n = num_landmarks;
  executor.for_ranges(results.size() * n, kGrain, [&](std::size_t begin, std::size_t end) {
    while (begin < end) {
      const std::size_t t = begin / n, first = begin - t * n;
      const std::size_t last = std::min(n, first + (end - begin));
      search(t, first, last, keys[t].data(), results[t].in_view.data());
      begin += last - first;
    }
  });
}

}  // namespace

void search_by_projection(const Executor& executor, const StereoRig& rig,
                          const PyramidScales& scales, std::span<const SearchTarget> targets,
                          const LandmarkView& landmarks, const ProjectionSearchOptions& options,
                          std::span<ProjectionMatches> results) {
  check_arguments(scales, targets, landmarks, options, results);
  const std::size_t n = landmarks.size();
  std::vector<TargetView> views;
  views.reserve(targets.size());
  for (const SearchTarget& target : targets) views.push_back(make_target_view(target));
  std::vector<std::vector<MatchKey>> keys(targets.size());
  for (std::size_t t = 0; t < targets.size(); ++t) {
    keys[t].resize(n);
    results[t].in_view.resize(n);
  }
  const ProjectionRule rule = make_rule(rig, scales, options);
  const LandmarkArrays arrays = make_arrays(landmarks);
  if (executor.kind() == Executor::Kind::kReference) {
    search_all(executor, ScalarSearch<PortableDistances>{{rule, arrays, {}}, views}, n, keys, results);
  } else if (can_sight_batches() && OrderedKeypoints::supported()) {
    VectorSearch search{rule, arrays, views, {}};
    search.keypoints.resize(views.size());
    executor.for_ranges(views.size(), 1, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin)
        search.keypoints[begin] = OrderedKeypoints(views[begin].features);
    });
    search_all(executor, search, n, keys, results);
  } else {
    search_all(executor, ScalarSearch<CpuDistances>{{rule, arrays, {}}, views}, n, keys, results);
  }
  executor.for_ranges(targets.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t t = begin; t < end; ++t) {
      ProjectionMatches& r = results[t];
      r.keypoint.resize(n);
      r.distance.resize(n);
      r.count = resolve_claims(keys[t], targets[t].features->size(), r.keypoint, r.distance);
    }
  });
}

}  // namespace fastloop::matching
