#include "fastloop/mapping/culling.hpp"

#include <algorithm>

namespace fastloop::mapping {
namespace {

constexpr double kMinFoundRatio = 0.25;
constexpr std::uint32_t kProbationKeyframes = 3;
constexpr int kRedundantObservers = 3;
constexpr std::size_t kCullCandidates = 15;
constexpr std::size_t kProtectedRecent =
    12;  ///< with IMU: the window of the local adjustment stays

/// Share of a keyframe's close landmarks that enough other keyframes see at least as finely.
double redundant_share(const map::Map& map, KeyframeId id, float close_depth_m) {
  const map::Keyframe& k = map.keyframe(id);
  const FeatureSet& f = *k.data->features;
  int considered = 0, redundant = 0;
  for (std::size_t i = 0; i < k.landmarks.size(); ++i) {
    if (!k.landmarks[i].valid() || (f.has_depth(i) && f.depth_m[i] > close_depth_m)) continue;
    ++considered;
    int observers = 0;
    for (const map::Observation& o : map.landmark(k.landmarks[i]).observations) {
      if (o.keyframe == id) continue;
      if (map.keyframe(o.keyframe).data->features->octave[o.keypoint] <= f.octave[i] + 1 &&
          ++observers >= kRedundantObservers)
        break;
    }
    redundant += observers >= kRedundantObservers;
  }
  // A keyframe of which nothing can be judged stays.
  return considered == 0 ? 0.0 : static_cast<double>(redundant) / considered;
}

bool gap_allows_removal(const map::Map& map, KeyframeId id, const MappingOptions& options) {
  const map::Keyframe& k = map.keyframe(id);
  const Nanoseconds begin = map.keyframe(k.previous).data->stamp_ns;
  const Nanoseconds end = map.keyframe(k.next).data->stamp_ns;
  return to_seconds(end - begin) < options.max_imu_gap_s;
}

/// The measurement of a closed loop stays with its keyframes.
bool ends_loop(const map::Map& map, KeyframeId id) {
  const auto& loops = map.loop_edges();
  return std::any_of(loops.begin(), loops.end(),
                     [&](const map::LoopEdge& e) { return e.a == id || e.b == id; });
}

}  // namespace

void LandmarkProbation::review(map::Map& map, KeyframeId newest) {
  std::vector<LandmarkId> still_young;
  for (const LandmarkId id : young_) {
    if (!map.contains(id)) continue;
    const map::Landmark& l = map.landmark(id);
    const std::uint32_t age = newest.value() - l.first_keyframe.value();
    const bool rarely_found = l.found < kMinFoundRatio * l.visible;
    const bool unconfirmed = age >= 2 && l.observations.size() < 2;
    if (rarely_found || unconfirmed)
      map.remove_landmark(id);
    else if (age < kProbationKeyframes)
      still_young.push_back(id);
  }
  young_ = std::move(still_young);
}

int cull_keyframes(map::Map& map, KeyframeId keyframe, bool inertial,
                   const MappingOptions& options) {
  const map::MapInfo info = map.map_info(map.keyframe(keyframe).map);
  std::vector<KeyframeId> recent;
  if (options.use_imu) {
    KeyframeId k = keyframe;
    for (std::size_t i = 0; i < kProtectedRecent && k.valid(); ++i, k = map.keyframe(k).previous)
      recent.push_back(k);
  }
  const double limit = inertial ? options.redundant_share_inertial : options.redundant_share;
  const auto close = static_cast<float>(options.close_depth_baselines * map.rig().baseline_m);
  int removed = 0;
  for (const KeyframeId id : map.best_covisible(keyframe, kCullCandidates)) {
    if (id == info.first_keyframe || id == info.last_keyframe) continue;
    if (std::find(recent.begin(), recent.end(), id) != recent.end()) continue;
    const map::Keyframe& k = map.keyframe(id);
    if (!k.previous.valid() || !k.next.valid() || ends_loop(map, id)) continue;
    if (options.use_imu && (!inertial || !gap_allows_removal(map, id, options))) continue;
    if (redundant_share(map, id, close) > limit) {
      map.remove_keyframe(id);
      ++removed;
    }
  }
  return removed;
}

}  // namespace fastloop::mapping
