#include "fastloop/matching/projection_search.hpp"

#include <algorithm>
#include <bit>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/claims.hpp"
#include "fastloop/matching/ordered_scan.hpp"
#include "fastloop/matching/projection_math.hpp"
#include "fastloop/matching/projection_search_cuda.hpp"
#include "fastloop/matching/sight_batch.hpp"

namespace fastloop::matching {
namespace {

constexpr std::size_t kGrain = 256;  // landmarks worth a task

void require(bool condition, const char* message) {
  if (!condition) throw InvalidArgument(std::string("search_by_projection: ") + message);
}

void check_arguments(const PyramidScales& scales, const ProjectionJob& job,
                     const ProjectionSearchOptions& options) {
  const LandmarkView& landmarks = job.landmarks;
  const std::size_t n = landmarks.size();
  const bool needs_normals = options.min_view_cos > -1 || options.wide_factor != 1;
  require(landmarks.min_distance_m.size() == n && landmarks.max_distance_m.size() == n &&
              landmarks.descriptor.size() == n,
          "landmark arrays differ in length");
  require(landmarks.normal_world.size() == n || (landmarks.normal_world.empty() && !needs_normals),
          "landmark normals differ in length");
  require(scales.levels > 0 && scales.scale.size() == static_cast<std::size_t>(scales.levels) &&
              scales.sigma2.size() == scales.scale.size(),
          "incomplete pyramid scales");
  for (const SearchTarget& target : job.targets) {
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
  store_row_major(rig.T_right_left.rotation, rule.right_rotation);
  for (int i = 0; i < 3; ++i)
    rule.right_translation[i] = static_cast<float>(rig.T_right_left.translation[i]);
  rule.rectified = rig.kind == StereoRig::Kind::kRectified;
  rule.focal_baseline = static_cast<float>(rig.left.fx * rig.baseline_m);
  rule.need_right = o.check_right || o.chi2_gate_stereo > 0;
  if (rule.need_right) rule.right = make_camera_view(rig.right);
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

/// Best keypoint of every landmark, before claims are resolved. Every (target, landmark) pair writes
/// its own element of `keys` and `in_view`: no order matters.
template <class Search>
void search_all(const Executor& executor, const Search& search, std::size_t n,
                std::span<std::vector<MatchKey>> keys,
                std::span<std::vector<std::uint8_t>> in_view) {
  executor.for_ranges(keys.size() * n, kGrain, [&](std::size_t begin, std::size_t end) {
    while (begin < end) {
      const std::size_t t = begin / n, first = begin - t * n;
      const std::size_t last = std::min(n, first + (end - begin));
      search(t, first, last, keys[t].data(), in_view[t].data());
      begin += last - first;
    }
  });
}

void search_on_host(const Executor& executor, const ProjectionRule& rule,
                    const LandmarkArrays& arrays, std::size_t n, std::span<const TargetView> views,
                    std::span<std::vector<MatchKey>> keys,
                    std::span<std::vector<std::uint8_t>> in_view) {
  for (std::size_t t = 0; t < views.size(); ++t) {
    keys[t].resize(n);
    in_view[t].resize(n);
  }
  if (executor.sequential()) {
    search_all(executor, ScalarSearch<PortableDistances>{{rule, arrays, {}}, views}, n, keys,
               in_view);
  } else if (can_sight_batches() && OrderedKeypoints::supported()) {
    VectorSearch search{rule, arrays, views, {}};
    search.keypoints.resize(views.size());
    executor.for_ranges(views.size(), 1, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin)
        search.keypoints[begin] = OrderedKeypoints(views[begin].features);
    });
    search_all(executor, search, n, keys, in_view);
  } else {
    search_all(executor, ScalarSearch<CpuDistances>{{rule, arrays, {}}, views}, n, keys, in_view);
  }
}

std::vector<TargetView> make_target_views(std::span<const SearchTarget> targets) {
  std::vector<TargetView> views;
  views.reserve(targets.size());
  for (const SearchTarget& target : targets) views.push_back(make_target_view(target));
  return views;
}

/// False where the host must do it.
bool search_on_device(const Executor& executor, const ProjectionRule& rule,
                      std::span<const ProjectionJob> jobs, bool want_in_view,
                      ProjectionFound& found) {
  if (!executor.cuda_session()) return false;
  std::vector<LandmarksToSearch> landmarks;
  std::vector<TargetToSearch> targets;
  for (std::size_t j = 0; j < jobs.size(); ++j) {
    const LandmarkView& l = jobs[j].landmarks;
    landmarks.push_back({make_arrays(l), l.size(), l.resident});
    for (const SearchTarget& target : jobs[j].targets)
      targets.push_back({make_target_view(target), target.features, j});
  }
  return search_on_device(*executor.cuda_session(), {rule, landmarks, targets, want_in_view}, found);
}

/// The matches of one target as a result for each landmark.
void expand(std::span<const KeypointMatch> matches, std::span<const std::uint32_t> in_view,
            std::size_t n, ProjectionMatches& result) {
  result.keypoint.assign(n, kNoMatch);
  result.distance.assign(n, 0);
  result.in_view.resize(n);
  for (std::size_t i = 0; i < n; ++i) result.in_view[i] = in_view[i / 32] >> i % 32 & 1u;
  for (const KeypointMatch& m : matches) {
    result.keypoint[m.landmark] = m.keypoint;
    result.distance[m.landmark] = m.distance;
  }
  result.count = static_cast<int>(matches.size());
}

/// Claims resolved, by keypoint.
std::vector<KeypointMatch> matches_of(std::span<const MatchKey> keys, std::size_t num_keypoints) {
  constexpr std::uint64_t kNobody = ~std::uint64_t{0};
  std::vector<std::uint64_t> winner(num_keypoints, kNobody);  // distance << 32 | landmark
  for (std::size_t i = 0; i < keys.size(); ++i) {
    if (keys[i] == kNoKey) continue;
    std::uint64_t& w = winner[static_cast<std::size_t>(key_index(keys[i]))];
    w = std::min(w, static_cast<std::uint64_t>(key_distance(keys[i])) << 32 | i);
  }
  std::vector<KeypointMatch> matches;
  for (std::size_t k = 0; k < num_keypoints; ++k)
    if (winner[k] != kNobody)
      matches.push_back({static_cast<std::uint32_t>(winner[k]), static_cast<std::uint16_t>(k),
                         static_cast<std::uint16_t>(winner[k] >> 32)});
  return matches;
}

}  // namespace

void search_by_projection(const Executor& executor, const StereoRig& rig,
                          const PyramidScales& scales, std::span<const SearchTarget> targets,
                          const LandmarkView& landmarks, const ProjectionSearchOptions& options,
                          std::span<ProjectionMatches> results) {
  const ProjectionJob job{landmarks, targets};
  check_arguments(scales, job, options);
  require(results.size() == targets.size(), "one result per target");
  const std::size_t n = landmarks.size();
  const ProjectionRule rule = make_rule(rig, scales, options);
  if (ProjectionFound found; search_on_device(executor, rule, {&job, 1}, true, found)) {
    executor.for_ranges(targets.size(), 1, [&](std::size_t begin, std::size_t end) {
      for (std::size_t t = begin; t < end; ++t)
        expand(found.lists[t], found.words(t), n, results[t]);
    });
    return;
  }
  std::vector<std::vector<MatchKey>> keys(targets.size());
  std::vector<std::vector<std::uint8_t>> in_view(targets.size());
  for (std::size_t t = 0; t < targets.size(); ++t) in_view[t].swap(results[t].in_view);
  search_on_host(executor, rule, make_arrays(landmarks), n, make_target_views(targets), keys,
                 in_view);
  executor.for_ranges(targets.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t t = begin; t < end; ++t) {
      ProjectionMatches& r = results[t];
      r.in_view.swap(in_view[t]);
      r.keypoint.resize(n);
      r.distance.resize(n);
      r.count = resolve_claims(keys[t], targets[t].features->size(), r.keypoint, r.distance);
    }
  });
}

MatchLists find_by_projection(const Executor& executor, const StereoRig& rig,
                              const PyramidScales& scales, std::span<const ProjectionJob> jobs,
                              const ProjectionSearchOptions& options) {
  for (const ProjectionJob& job : jobs) check_arguments(scales, job, options);
  const ProjectionRule rule = make_rule(rig, scales, options);
  if (ProjectionFound found; search_on_device(executor, rule, jobs, false, found))
    return std::move(found.lists);
  MatchLists lists;
  for (const ProjectionJob& job : jobs) {
    const std::size_t count = job.targets.size();
    std::vector<std::vector<MatchKey>> keys(count);
    std::vector<std::vector<std::uint8_t>> in_view(count);
    std::vector<std::vector<KeypointMatch>> matches(count);
    search_on_host(executor, rule, make_arrays(job.landmarks), job.landmarks.size(),
                   make_target_views(job.targets), keys, in_view);
    executor.for_ranges(count, 1, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin)
        matches[begin] = matches_of(keys[begin], job.targets[begin].features->size());
    });
    for (const auto& m : matches) lists.append(m);
  }
  return lists;
}

void make_resident(const Executor& executor, const std::shared_ptr<const FeatureSet>& features) {
  if (CudaSession* session = executor.cuda_session(); session && session->usable())
    if (const auto store = resident_store(*session)) store->prefetch(features);
}

std::shared_ptr<const ResidentLandmarks> make_resident(const Executor& executor,
                                                       const LandmarkView& landmarks) {
  CudaSession* session = executor.cuda_session();
  if (!session || !session->usable()) return nullptr;
  const auto store = resident_store(*session);
  return store ? store->upload(make_arrays(landmarks), landmarks.size()) : nullptr;
}

}  // namespace fastloop::matching
