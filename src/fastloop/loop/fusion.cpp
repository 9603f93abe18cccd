#include "fastloop/loop/fusion.hpp"

#include <algorithm>
#include <array>
#include <tuple>

#include "fastloop/loop/flat_index.hpp"

namespace fastloop::loop {
namespace {

using map::Snapshot;

/// A keypoint that shows a landmark of the matched side.
struct Claim {
  std::uint32_t keyframe;  ///< index in the list of keyframes
  std::uint32_t keypoint;
  LandmarkId landmark;
};

/// Sets of landmarks that are one, with the keyframes that see any of them. All lists lie one after
/// another in one array; a list that grows is written anew at its end.
class Groups {
 public:
  Groups(const Snapshot& snapshot, std::size_t expected) : snapshot_(snapshot), node_(expected) {
    parent_.reserve(expected);
    list_.reserve(expected);
    pool_.reserve(16 * expected);
  }

  std::uint32_t of(LandmarkId id) {
    const std::uint32_t node = node_.number_of(id.value());
    if (node < parent_.size()) return root(node);
    parent_.push_back(node);
    const std::size_t begin = pool_.size();
    for (const map::Observation& o : snapshot_.landmark(id).observations)
      pool_.push_back(o.keyframe);
    list_.push_back({begin, pool_.size()});
    return node;
  }
  bool sees(std::uint32_t group, KeyframeId keyframe) const {
    const auto [begin, end] = list_[group];
    return std::binary_search(at(begin), at(end), keyframe);
  }
  void add_observer(std::uint32_t group, KeyframeId keyframe) {
    const List old = list_[group];
    const std::size_t begin = pool_.size();
    pool_.resize(begin + old.end - old.begin + 1);
    const auto middle = std::lower_bound(at(old.begin), at(old.end), keyframe);
    auto out = std::copy(at(old.begin), middle, pool_.begin() + static_cast<std::ptrdiff_t>(begin));
    *out++ = keyframe;
    std::copy(middle, at(old.end), out);
    list_[group] = {begin, pool_.size()};
  }
  /// Joins two groups unless a keyframe sees both.
  void join(std::uint32_t a, std::uint32_t b) {
    if (a == b) return;
    const List x = list_[a], y = list_[b];
    for (std::size_t i = x.begin, j = y.begin; i < x.end && j < y.end;) {
      if (pool_[i] == pool_[j]) return;
      pool_[i] < pool_[j] ? ++i : ++j;
    }
    const std::size_t begin = pool_.size();
    pool_.resize(begin + (x.end - x.begin) + (y.end - y.begin));
    std::merge(at(x.begin), at(x.end), at(y.begin), at(y.end),
               pool_.begin() + static_cast<std::ptrdiff_t>(begin));
    list_[a] = {begin, pool_.size()};
    parent_[b] = a;
  }
  std::size_t size() const { return parent_.size(); }
  LandmarkId landmark(std::size_t node) const { return LandmarkId(node_.key(node)); }
  std::uint32_t root(std::uint32_t n) {
    while (parent_[n] != n) n = parent_[n] = parent_[parent_[n]];
    return n;
  }

 private:
  struct List {
    std::size_t begin, end;
  };
  std::vector<KeyframeId>::const_iterator at(std::size_t i) const {
    return pool_.begin() + static_cast<std::ptrdiff_t>(i);
  }

  const Snapshot& snapshot_;
  FlatIndex node_;
  std::vector<std::uint32_t> parent_;
  std::vector<List> list_;  ///< of roots: observers, ascending
  std::vector<KeyframeId> pool_;
};

/// Keyframes that take part, ascending, and where each one's keypoints begin in a common list.
struct Places {
  std::vector<KeyframeId> keyframes;
  std::vector<std::size_t> searched;  ///< [keyframes] index in `moved`, or its size
  std::vector<std::size_t> first_keypoint;
  std::size_t keypoints = 0;

  Places(const Snapshot& snapshot, KeyframeId current, std::span<const MovedKeyframe> moved) {
    std::vector<std::pair<KeyframeId, std::size_t>> all;
    for (std::size_t t = 0; t < moved.size(); ++t) all.emplace_back(moved[t].keyframe, t);
    if (std::none_of(all.begin(), all.end(), [&](const auto& p) { return p.first == current; }))
      all.emplace_back(current, moved.size());
    std::sort(all.begin(), all.end());
    for (const auto& [id, t] : all) {
      keyframes.push_back(id);
      searched.push_back(t);
      first_keypoint.push_back(keypoints);
      keypoints += snapshot.keyframe(id).landmarks.size();
    }
  }
};

/// What was found, by distance, then keyframe, then keypoint: written into place, not sorted.
std::vector<Claim> ordered_claims(const Places& places, const matching::MatchLists& found,
                                  const map::LandmarkArrays& cloud) {
  std::array<std::size_t, 258> next{};  // first place of each distance
  for (const matching::KeypointMatch& m : found.matches) ++next[m.distance + 1u];
  for (std::size_t d = 1; d < next.size(); ++d) next[d] += next[d - 1];
  std::vector<Claim> claims(next.back());
  for (std::uint32_t k = 0; k < places.keyframes.size(); ++k)
    if (places.searched[k] < found.size())
      for (const matching::KeypointMatch& m : found[places.searched[k]])
        claims[next[m.distance]++] = {k, m.keypoint, cloud.ids[m.landmark]};
  return claims;
}

/// The oldest landmark of a group stands for it: it belongs to the side that stays.
void name_winners(Groups& groups, Fusion& fusion) {
  std::vector<LandmarkId> winner(groups.size());
  for (std::uint32_t n = 0; n < groups.size(); ++n) {
    LandmarkId& w = winner[groups.root(n)];
    w = std::min(w, groups.landmark(n));  // an invalid id is larger than all others
  }
  for (std::uint32_t n = 0; n < groups.size(); ++n)
    if (const LandmarkId w = winner[groups.root(n)]; w != groups.landmark(n))
      fusion.merges.push_back({groups.landmark(n), w});
  for (map::NewObservation& o : fusion.observations) o.landmark = winner[groups.of(o.landmark)];
  std::sort(fusion.merges.begin(), fusion.merges.end(),
            [](const auto& a, const auto& b) { return a.loser < b.loser; });
  std::sort(fusion.observations.begin(), fusion.observations.end(),
            [](const auto& a, const auto& b) {
              return std::tie(a.keyframe, a.keypoint) < std::tie(b.keyframe, b.keypoint);
            });
}

}  // namespace

Fusion fuse_loop(const StepExecutors& executors, const Snapshot& snapshot, const LoopOptions& options,
                 const RegionMatch& match, std::span<const MovedKeyframe> moved,
                 const map::LandmarkArrays& cloud) {
  if (executors.reference())
    return fuse_loop_reference(snapshot, options, match, moved, cloud);
  auto resident = match.resident;
  const PlaceSearch place{&cloud, moved, resident ? &resident : nullptr};
  const matching::MatchLists found =
      find_in_keyframes(executors, snapshot, {&place, 1}, options.fusion_radius_px,
                        options.fusion_max_distance);
  const Places places(snapshot, match.current, moved);
  Groups groups(snapshot, 4 * cloud.size());
  std::vector<std::uint8_t> taken(places.keypoints, 0);
  Fusion fusion;
  const auto take = [&](const Claim& c) {
    const std::uint32_t group = groups.of(c.landmark);
    const KeyframeId keyframe = places.keyframes[c.keyframe];
    const LandmarkId there = snapshot.keyframe(keyframe).landmarks[c.keypoint];
    if (there.valid()) {
      groups.join(group, groups.of(there));
      return;
    }
    std::uint8_t& occupied = taken[places.first_keypoint[c.keyframe] + c.keypoint];
    if (occupied || groups.sees(group, keyframe)) return;
    occupied = 1;
    groups.add_observer(group, keyframe);
    fusion.observations.push_back({c.landmark, keyframe, c.keypoint});
  };
  // What verification confirmed comes first.
  const auto current = static_cast<std::uint32_t>(
      std::lower_bound(places.keyframes.begin(), places.keyframes.end(), match.current) -
      places.keyframes.begin());
  for (std::uint32_t i = 0; i < match.landmarks.size(); ++i)
    if (match.landmarks[i].valid()) take({current, i, match.landmarks[i]});
  for (const Claim& c : ordered_claims(places, found, cloud)) take(c);
  name_winners(groups, fusion);
  return fusion;
}

}  // namespace fastloop::loop
