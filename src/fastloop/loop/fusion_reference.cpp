#include "fastloop/loop/fusion.hpp"

#include <algorithm>
#include <tuple>
#include <unordered_map>

namespace fastloop::loop {
namespace {

using map::Snapshot;

/// A keypoint that shows a landmark of the matched side.
struct Claim {
  int distance;  ///< Hamming; -1: confirmed by verification
  KeyframeId keyframe;
  std::uint32_t keypoint;
  LandmarkId landmark;
  auto key() const { return std::tie(distance, keyframe, keypoint, landmark); }
};

/// Sets of landmarks that are one, with the keyframes that see any of them.
class Groups {
 public:
  explicit Groups(const Snapshot& snapshot) : snapshot_(snapshot) {}

  std::size_t of(LandmarkId id) {
    const auto [it, added] = node_.try_emplace(id, parent_.size());
    if (added) {
      parent_.push_back(it->second);
      landmark_.push_back(id);
      std::vector<KeyframeId> seen;
      for (const map::Observation& o : snapshot_.landmark(id).observations)
        seen.push_back(o.keyframe);
      observers_.push_back(std::move(seen));
    }
    return root(it->second);
  }
  bool sees(std::size_t group, KeyframeId keyframe) const {
    return std::binary_search(observers_[group].begin(), observers_[group].end(), keyframe);
  }
  void add_observer(std::size_t group, KeyframeId keyframe) {
    auto& seen = observers_[group];
    seen.insert(std::lower_bound(seen.begin(), seen.end(), keyframe), keyframe);
  }
  /// Joins two groups unless a keyframe sees both.
  bool join(std::size_t a, std::size_t b) {
    if (a == b) return true;
    auto &seen_a = observers_[a], &seen_b = observers_[b];
    for (std::size_t i = 0, j = 0; i < seen_a.size() && j < seen_b.size();) {
      if (seen_a[i] == seen_b[j]) return false;
      seen_a[i] < seen_b[j] ? ++i : ++j;
    }
    std::vector<KeyframeId> all(seen_a.size() + seen_b.size());
    std::merge(seen_a.begin(), seen_a.end(), seen_b.begin(), seen_b.end(), all.begin());
    seen_a = std::move(all);
    seen_b.clear();
    parent_[b] = a;
    return true;
  }
  const std::vector<LandmarkId>& landmarks() const { return landmark_; }

 private:
  std::size_t root(std::size_t n) {
    while (parent_[n] != n) n = parent_[n] = parent_[parent_[n]];
    return n;
  }

  const Snapshot& snapshot_;
  std::unordered_map<LandmarkId, std::size_t> node_;
  std::vector<std::size_t> parent_;
  std::vector<LandmarkId> landmark_;
  std::vector<std::vector<KeyframeId>> observers_;  ///< of roots, ascending
};

std::vector<Claim> search(const Snapshot& snapshot, const LoopOptions& options,
                          std::span<const MovedKeyframe> moved, const map::LandmarkArrays& cloud) {
  const std::vector<matching::ProjectionMatches> found =
      search_keyframes(Executor::reference(), snapshot, moved, cloud, options.fusion_radius_px,
                       options.fusion_max_distance);
  std::vector<Claim> claims;
  for (std::size_t t = 0; t < moved.size(); ++t)
    for (std::size_t i = 0; i < cloud.size(); ++i)
      if (found[t].keypoint[i] != matching::kNoMatch)
        claims.push_back({found[t].distance[i], moved[t].keyframe,
                          static_cast<std::uint32_t>(found[t].keypoint[i]), cloud.ids[i]});
  return claims;
}

}  // namespace

Fusion fuse_loop_reference(const Snapshot& snapshot, const LoopOptions& options,
                           const RegionMatch& match, std::span<const MovedKeyframe> moved,
                           const map::LandmarkArrays& cloud) {
  std::vector<Claim> claims = search(snapshot, options, moved, cloud);
  for (std::uint32_t i = 0; i < match.landmarks.size(); ++i)
    if (match.landmarks[i].valid()) claims.push_back({-1, match.current, i, match.landmarks[i]});
  std::sort(claims.begin(), claims.end(),
            [](const Claim& a, const Claim& b) { return a.key() < b.key(); });

  Groups groups(snapshot);
  std::unordered_map<std::uint64_t, std::size_t> taken;  // (keyframe, keypoint) -> group seen there
  Fusion fusion;
  for (const Claim& c : claims) {
    const std::size_t group = groups.of(c.landmark);
    const LandmarkId there = snapshot.keyframe(c.keyframe).landmarks[c.keypoint];
    if (there.valid()) {
      groups.join(group, groups.of(there));
      continue;
    }
    const std::uint64_t place = std::uint64_t{c.keyframe.value()} << 32 | c.keypoint;
    if (groups.sees(group, c.keyframe) || !taken.try_emplace(place, group).second) continue;
    groups.add_observer(group, c.keyframe);
    fusion.observations.push_back({c.landmark, c.keyframe, c.keypoint});
  }

  // The oldest landmark of a group stands for it: it belongs to the side that stays.
  std::unordered_map<std::size_t, LandmarkId> winner;
  for (const LandmarkId id : groups.landmarks()) {
    const auto [it, added] = winner.try_emplace(groups.of(id), id);
    if (!added) it->second = std::min(it->second, id);
  }
  for (const LandmarkId id : groups.landmarks())
    if (const LandmarkId w = winner[groups.of(id)]; w != id) fusion.merges.push_back({id, w});
  for (map::NewObservation& o : fusion.observations) o.landmark = winner[groups.of(o.landmark)];
  std::sort(fusion.merges.begin(), fusion.merges.end(),
            [](const auto& a, const auto& b) { return a.loser < b.loser; });
  std::sort(fusion.observations.begin(), fusion.observations.end(), [](const auto& a, const auto& b) {
    return std::tie(a.keyframe, a.keypoint) < std::tie(b.keyframe, b.keypoint);
  });
  return fusion;
}

}  // namespace fastloop::loop
