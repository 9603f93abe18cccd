#include "fastloop/loop/fusion.hpp"

#include <algorithm>
#include <array>
#include <numeric>
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
  std::uint32_t node = 0;         ///< of the landmark
  std::uint32_t there = kNobody;  ///< node of the landmark that the keypoint shows already

  static constexpr std::uint32_t kNobody = 0xffffffffu;
};

/// Sets of landmarks that are one, with the keyframes that see any of them. All lists lie one after
/// another in one array; a list that grows is written anew at its end.
class Groups {
 public:
  explicit Groups(std::size_t expected) : node_(expected) {}

  /// A group of its own for each landmark; all of them before gather().
  std::uint32_t number_of(LandmarkId id) { return node_.number_of(id.value()); }

  /// Takes in who sees what, on all cores: landmarks and their lists lie scattered in memory.
  void gather(const Executor& executor, const Snapshot& snapshot) {
    parent_.resize(node_.size());
    std::iota(parent_.begin(), parent_.end(), 0u);
    list_.resize(node_.size());
    std::vector<const std::vector<map::Observation>*> seen(node_.size());
    executor.for_ranges(node_.size(), kGrain, [&](std::size_t begin, std::size_t end) {
      for (std::size_t n = begin; n < end; ++n) {
        seen[n] = &snapshot.landmark(landmark(n)).observations;
        list_[n].end = seen[n]->size();
      }
    });
    std::size_t total = 0;
    for (List& list : list_) {
      list.begin = total;
      list.end = total += list.end;
    }
    pool_.reserve(4 * total);
    pool_.resize(total);
    executor.for_ranges(node_.size(), kGrain, [&](std::size_t begin, std::size_t end) {
      for (std::size_t n = begin; n < end; ++n) {
        KeyframeId* out = pool_.data() + list_[n].begin;
        for (const map::Observation& o : *seen[n]) *out++ = o.keyframe;
      }
    });
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
  std::size_t size() const { return node_.size(); }
  LandmarkId landmark(std::size_t node) const { return LandmarkId(node_.key(node)); }
  std::uint32_t root(std::uint32_t n) {
    while (parent_[n] != n) n = parent_[n] = parent_[parent_[n]];
    return n;
  }

 private:
  static constexpr std::size_t kGrain = 256;  // landmarks worth a task

  struct List {
    std::size_t begin = 0, end = 0;
  };
  std::vector<KeyframeId>::const_iterator at(std::size_t i) const {
    return pool_.begin() + static_cast<std::ptrdiff_t>(i);
  }

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

/// What verification confirmed, then what was found by distance, then keyframe, then keypoint:
/// written into place, not sorted.
std::vector<Claim> ordered_claims(const Places& places, const RegionMatch& match,
                                  const matching::MatchLists& found,
                                  const map::LandmarkArrays& cloud) {
  std::vector<Claim> claims;
  const auto current = static_cast<std::uint32_t>(
      std::lower_bound(places.keyframes.begin(), places.keyframes.end(), match.current) -
      places.keyframes.begin());
  for (std::uint32_t i = 0; i < match.landmarks.size(); ++i)
    if (match.landmarks[i].valid()) claims.push_back({current, i, match.landmarks[i]});
  std::array<std::size_t, 258> next{};  // first place of each distance
  for (const matching::KeypointMatch& m : found.matches) ++next[m.distance + 1u];
  next[0] = claims.size();
  for (std::size_t d = 1; d < next.size(); ++d) next[d] += next[d - 1];
  claims.resize(next.back());
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
  for (map::NewObservation& o : fusion.observations) o.landmark = winner[groups.root(groups.number_of(o.landmark))];
  std::sort(fusion.merges.begin(), fusion.merges.end(),
            [](const auto& a, const auto& b) { return a.loser < b.loser; });
  const auto place_of = [](const map::NewObservation& o) {
    return std::uint64_t{o.keyframe.value()} << 32 | o.keypoint;
  };
  std::sort(fusion.observations.begin(), fusion.observations.end(),
            [&](const auto& a, const auto& b) { return place_of(a) < place_of(b); });
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
  std::vector<Claim> claims = ordered_claims(places, match, found, cloud);
  Groups groups(4 * cloud.size());
  for (Claim& c : claims) {
    c.node = groups.number_of(c.landmark);
    const LandmarkId there = snapshot.keyframe(places.keyframes[c.keyframe]).landmarks[c.keypoint];
    if (there.valid()) c.there = groups.number_of(there);
  }
  groups.gather(executors.host(), snapshot);
  Fusion fusion;
  std::vector<std::uint8_t> taken(places.keypoints, 0);
  for (const Claim& c : claims) {
    const std::uint32_t group = groups.root(c.node);
    if (c.there != Claim::kNobody) {
      groups.join(group, groups.root(c.there));
      continue;
    }
    const KeyframeId keyframe = places.keyframes[c.keyframe];
    std::uint8_t& occupied = taken[places.first_keypoint[c.keyframe] + c.keypoint];
    if (occupied || groups.sees(group, keyframe)) continue;
    occupied = 1;
    groups.add_observer(group, keyframe);
    fusion.observations.push_back({c.landmark, keyframe, c.keypoint});
  }
  name_winners(groups, fusion);
  return fusion;
}

}  // namespace fastloop::loop
