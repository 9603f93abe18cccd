#include <algorithm>

#include "fastloop/core/time.hpp"
#include "fastloop/map/map.hpp"

/// Joining many landmarks at once.
namespace fastloop::map {
namespace {

/// More keyframes than this see none of what is joined in practice; a table of their pairs would
/// grow large.
constexpr std::size_t kMaxInvolved = 4096;
constexpr std::size_t kGrain = 64;  // landmarks worth a task

/// Keyframes that see any of the landmarks named, and a table of what changes between them.
class SharedChanges {
 public:
  SharedChanges(const Snapshot& map, std::span<const LandmarkMerge> merges,
                std::span<const NewObservation> observations)
      : index_(map.keyframe_slots(), -1) {
    const auto involve = [&](LandmarkId id) {
      id = map.resolve(id);
      if (id.valid())
        for (const Observation& o : map.landmark(id).observations) take(o.keyframe);
    };
    for (const LandmarkMerge& m : merges) involve(m.loser);
    for (const NewObservation& o : observations) take(o.keyframe);
    num_rewritten_ = keyframes_.size();
    for (const LandmarkMerge& m : merges) involve(m.winner);
    for (const NewObservation& o : observations) involve(o.landmark);
    if (fits()) change_.assign(keyframes_.size() * keyframes_.size(), 0);
  }
  bool fits() const { return keyframes_.size() <= kMaxInvolved; }
  std::span<const KeyframeId> keyframes() const { return keyframes_; }
  /// Those whose keypoints will show another landmark, or none.
  std::span<const KeyframeId> rewritten() const {
    return std::span(keyframes_).first(num_rewritten_);
  }

  /// Between one keyframe and each of several others.
  void add(KeyframeId a, std::span<const Observation> others, int change) {
    std::int32_t* row = change_.data() + of(a) * keyframes_.size();
    for (const Observation& o : others) row[of(o.keyframe)] += change;
  }
  /// Changes of a keyframe's counts; both directions of a pair count.
  int between(std::size_t a, std::size_t b) const {
    return change_[a * keyframes_.size() + b] + change_[b * keyframes_.size() + a];
  }

 private:
  std::size_t of(KeyframeId id) const { return static_cast<std::size_t>(index_[id.value()]); }
  void take(KeyframeId id) {
    std::int32_t& index = index_[id.value()];
    if (index >= 0) return;
    index = static_cast<std::int32_t>(keyframes_.size());
    keyframes_.push_back(id);
  }

  std::vector<std::int32_t> index_;  ///< [keyframe slots] place in keyframes_ or -1
  std::vector<KeyframeId> keyframes_;
  std::size_t num_rewritten_ = 0;
  std::vector<std::int32_t> change_;  ///< [keyframes_ x keyframes_]
};

bool earlier(const Observation& a, const Observation& b) {
  return a.keyframe < b.keyframe;
}

/// The observations of two landmarks, split by whether the winner may take the loser's. One object
/// serves many pairs, so that its lists are allocated once.
struct JoinedObservations {
  std::vector<Observation> moved, refused, all;
  void join(const std::vector<Observation>& loser, const std::vector<Observation>& winner) {
    moved.clear();
    refused.clear();
    std::set_difference(loser.begin(), loser.end(), winner.begin(), winner.end(),
                        std::back_inserter(moved), earlier);
    if (moved.size() < loser.size())
      std::set_intersection(loser.begin(), loser.end(), winner.begin(), winner.end(),
                            std::back_inserter(refused), earlier);
    all.resize(winner.size() + moved.size());
    std::merge(winner.begin(), winner.end(), moved.begin(), moved.end(), all.begin(), earlier);
  }
};

}  // namespace

/// Access to the map's tables for one call of fuse_landmarks.
class LandmarkFusion {
 public:
  LandmarkFusion(Map& map, SharedChanges& changes) : map_(map), changes_(changes) {}

  /// Clones what snapshots share of the landmarks to be written to, on all cores: a chunk holds
  /// many lists, and cloning one after another would take longer than all the rest. Comes first, for
  /// it also brings all that into the caches.
  static void unshare_landmarks(Map& map, const Executor& executor,
                                std::span<const LandmarkMerge> merges,
                                std::span<const NewObservation> observations) {
    constexpr std::size_t kChunk = Map::Landmarks::kItems;
    std::vector<std::uint8_t> wanted(map.landmark_slots() / kChunk + 1, 0);
    const auto want = [&](LandmarkId id) {
      if (id = map.resolve(id); id.valid()) wanted[id.value() / kChunk] = 1;
    };
    for (const LandmarkMerge& m : merges) {
      want(m.loser);
      want(m.winner);
    }
    for (const NewObservation& o : observations) want(o.landmark);
    std::vector<std::size_t> chunks;
    for (std::size_t c = 0; c < wanted.size(); ++c)
      if (wanted[c]) chunks.push_back(c);
    executor.for_ranges(chunks.size(), 2, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin) map.landmarks_.mutate(chunks[begin] * kChunk);
    });
  }

  /// The same for the lists of the keyframes that see what is joined.
  void unshare_keyframes(const Executor& executor) {
    std::vector<KeypointLandmarks*> lists;
    for (const KeyframeId id : changes_.rewritten())
      lists.push_back(&map_.keyframes_.mutate(id.value()).landmarks);
    executor.for_ranges(lists.size(), 4, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin) lists[begin]->unshare();
    });
  }

  bool merge(LandmarkId loser, LandmarkId winner) {
    if (!loser.valid() || !winner.valid() || loser == winner) return false;
    JoinedObservations& joined = joined_;
    joined.join(map_.landmark(loser).observations, map_.landmark(winner).observations);
    // Pairs that saw the loser together now see the winner; new are those across.
    for (const Observation& o : joined.moved) {
      changes_.add(o.keyframe, map_.landmark(winner).observations, +1);
      map_.keyframes_.mutate(o.keyframe.value()).landmarks.set(o.keypoint, winner);
    }
    for (std::size_t i = 0; i < joined.refused.size(); ++i) {
      const Observation& o = joined.refused[i];
      changes_.add(o.keyframe, joined.moved, -1);
      changes_.add(o.keyframe, std::span(joined.refused).first(i), -1);
      map_.keyframes_.mutate(o.keyframe.value()).landmarks.set(o.keypoint, LandmarkId{});
    }
    Landmark& gone = map_.landmarks_.mutate(loser.value());
    gone.anchor = KeyframeId{};
    gone.replaced_by = winner;
    gone.observations = {};
    const std::uint32_t visible = gone.visible, found = gone.found;
    Landmark& kept = map_.landmarks_.mutate(winner.value());
    kept.observations = joined.all;
    kept.visible += visible;
    kept.found += found;
    --map_.num_landmarks_;
    touched_.push_back(winner);
    return true;
  }

  bool observe(LandmarkId id, KeyframeId keyframe, std::uint32_t keypoint) {
    if (!id.valid() || !map_.contains(keyframe) ||
        map_.keyframe(keyframe).landmarks[keypoint].valid())
      return false;
    const Observation added{keyframe, keypoint};
    const std::vector<Observation>& present = map_.landmark(id).observations;
    if (std::binary_search(present.begin(), present.end(), added, earlier)) return false;
    changes_.add(keyframe, present, +1);
    auto& observations = map_.landmarks_.mutate(id.value()).observations;
    observations.insert(std::upper_bound(observations.begin(), observations.end(), added, earlier),
                        added);
    map_.keyframes_.mutate(keyframe.value()).landmarks.set(keypoint, id);
    touched_.push_back(id);
    return true;
  }

  void refresh(const Executor& executor) {
    std::sort(touched_.begin(), touched_.end());
    touched_.erase(std::unique(touched_.begin(), touched_.end()), touched_.end());
    std::erase_if(touched_, [&](LandmarkId id) { return !map_.contains(id); });
    // Nobody shares these landmarks any more, and the looks of one do not depend on another's.
    executor.for_ranges(touched_.size(), kGrain, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin) map_.refresh_landmark(touched_[begin]);
    });
  }

  void change_covisibility() {
    const std::span<const KeyframeId> involved = changes_.keyframes();
    std::vector<std::size_t> ascending(involved.size());
    for (std::size_t i = 0; i < ascending.size(); ++i) ascending[i] = i;
    std::sort(ascending.begin(), ascending.end(),
              [&](std::size_t a, std::size_t b) { return involved[a] < involved[b]; });
    std::vector<CovisibilityEdge> changes, edges;
    for (const std::size_t a : ascending) {
      changes.clear();
      for (const std::size_t b : ascending)
        if (const int change = changes_.between(a, b); change != 0 && a != b)
          changes.push_back({involved[b], change});
      if (changes.empty()) continue;
      add_up(map_.covisible(involved[a]), changes, edges);
      map_.covisibility_.mutate(involved[a].value()) = edges;
    }
  }

 private:
  /// Both lists ascend by keyframe; pairs that share nothing any more are left out.
  static void add_up(const std::vector<CovisibilityEdge>& before,
                     const std::vector<CovisibilityEdge>& changes,
                     std::vector<CovisibilityEdge>& after) {
    after.clear();
    std::size_t i = 0, j = 0;
    while (i < before.size() || j < changes.size()) {
      CovisibilityEdge e;
      if (j == changes.size() || (i < before.size() && before[i].keyframe < changes[j].keyframe)) {
        e = before[i++];
      } else {
        e = changes[j++];
        if (i < before.size() && before[i].keyframe == e.keyframe) e.shared += before[i++].shared;
      }
      if (e.shared > 0) after.push_back(e);
    }
  }

  Map& map_;
  SharedChanges& changes_;
  JoinedObservations joined_;
  std::vector<LandmarkId> touched_;
};

Map::FusionOutcome Map::fuse_landmarks(const Executor& executor,
                                       std::span<const LandmarkMerge> merges,
                                       std::span<const NewObservation> observations) {
  if (executor.kind() == Executor::Kind::kReference)
    return fuse_landmarks_reference(merges, observations);
  const Stopwatch watch;
  LandmarkFusion::unshare_landmarks(*this, executor, merges, observations);
  SharedChanges changes(*this, merges, observations);
  if (!changes.fits()) return fuse_landmarks_reference(merges, observations);
  FusionOutcome outcome;
  LandmarkFusion fusion(*this, changes);
  fusion.unshare_keyframes(executor);
  for (const LandmarkMerge& m : merges)
    outcome.merged += fusion.merge(resolve(m.loser), resolve(m.winner));
  for (const NewObservation& o : observations)
    outcome.observed += fusion.observe(resolve(o.landmark), o.keyframe, o.keypoint);
  const double joined_ms = watch.elapsed_ms();
  fusion.change_covisibility();
  outcome.covisibility_ms = watch.elapsed_ms() - joined_ms;
  fusion.refresh(executor);
  outcome.landmarks_ms = watch.elapsed_ms() - outcome.covisibility_ms;
  ++version_;
  return outcome;
}

/// As published: landmark after landmark, descriptor and viewing direction anew after each.
Map::FusionOutcome Map::fuse_landmarks_reference(std::span<const LandmarkMerge> merges,
                                                 std::span<const NewObservation> observations) {
  const Stopwatch watch;
  FusionOutcome outcome;
  for (const LandmarkMerge& m : merges) {
    const LandmarkId loser = resolve(m.loser), winner = resolve(m.winner);
    if (!loser.valid() || !winner.valid() || loser == winner) continue;
    replace_landmark(loser, winner, true);
    ++outcome.merged;
  }
  std::vector<LandmarkId> touched;
  for (const NewObservation& o : observations) {
    const LandmarkId id = resolve(o.landmark);
    if (!id.valid() || !add_observation(id, o.keyframe, o.keypoint)) continue;
    touched.push_back(id);
    ++outcome.observed;
  }
  std::sort(touched.begin(), touched.end());
  touched.erase(std::unique(touched.begin(), touched.end()), touched.end());
  for (const LandmarkId id : touched)
    if (contains(id)) set_appearance(id, appearance_of(id, true));
  outcome.landmarks_ms = watch.elapsed_ms();
  return outcome;
}

}  // namespace fastloop::map
