#include "fastloop/loop/connections.hpp"

#include <algorithm>
#include <map>
#include <unordered_map>

namespace fastloop::loop {
namespace {

using map::LoopConnection;
using map::Snapshot;

int shared_before(const Snapshot& snapshot, KeyframeId a, KeyframeId b) {
  const auto& edges = snapshot.covisible(a);
  const auto it =
      std::lower_bound(edges.begin(), edges.end(), b,
                       [](const map::CovisibilityEdge& e, KeyframeId id) { return e.keyframe < id; });
  return it != edges.end() && it->keyframe == b ? it->shared : 0;
}

/// Observers of a landmark after the fusion, in the parts they come from: one part for each landmark
/// of its group, and one keyframe for each new observation.
class Groups {
 public:
  Groups(const Snapshot& snapshot, const Fusion& fusion) {
    for (const map::LandmarkMerge& m : fusion.merges) {
      auto& parts = parts_[m.winner];
      if (parts.empty()) parts.push_back(observers(snapshot, m.winner));
      parts.push_back(observers(snapshot, m.loser));
      winner_[m.loser] = m.winner;
    }
    for (const map::NewObservation& o : fusion.observations) {
      auto& parts = parts_[o.landmark];
      if (parts.empty()) parts.push_back(observers(snapshot, o.landmark));
      parts.push_back({o.keyframe});
    }
  }
  using Parts = std::vector<std::vector<KeyframeId>>;
  const std::unordered_map<LandmarkId, Parts>& changed() const { return parts_; }
  LandmarkId winner(LandmarkId id) const {
    const auto it = winner_.find(id);
    return it == winner_.end() ? id : it->second;
  }

 private:
  static std::vector<KeyframeId> observers(const Snapshot& snapshot, LandmarkId id) {
    std::vector<KeyframeId> seen;
    for (const map::Observation& o : snapshot.landmark(id).observations) seen.push_back(o.keyframe);
    return seen;
  }
  std::unordered_map<LandmarkId, Parts> parts_;
  std::unordered_map<LandmarkId, LandmarkId> winner_;
};

/// Index of a keyframe in the ascending list, or -1.
int index_of(std::span<const KeyframeId> sorted, KeyframeId id) {
  const auto it = std::lower_bound(sorted.begin(), sorted.end(), id);
  return it != sorted.end() && *it == id ? static_cast<int>(it - sorted.begin()) : -1;
}

std::vector<KeyframeId> ascending(std::span<const KeyframeId> ids) {
  std::vector<KeyframeId> sorted(ids.begin(), ids.end());
  std::sort(sorted.begin(), sorted.end());
  return sorted;
}

}  // namespace

std::vector<LoopConnection> find_connections(const Snapshot& snapshot,
                                             std::span<const KeyframeId> connected,
                                             const Fusion& fusion, int min_shared) {
  const std::vector<KeyframeId> inside = ascending(connected);
  const std::size_t slots = snapshot.keyframe_slots();
  std::vector<int> gained(inside.size() * slots, 0);
  const Groups groups(snapshot, fusion);
  for (const auto& [landmark, parts] : groups.changed())
    for (std::size_t p = 0; p < parts.size(); ++p)
      for (const KeyframeId a : parts[p]) {
        const int row = index_of(inside, a);
        if (row < 0) continue;
        int* counts = gained.data() + static_cast<std::size_t>(row) * slots;
        for (std::size_t q = 0; q < parts.size(); ++q)
          if (q != p)
            for (const KeyframeId b : parts[q]) ++counts[b.value()];
      }
  std::vector<LoopConnection> connections;
  for (std::size_t row = 0; row < inside.size(); ++row)
    for (std::uint32_t b = 0; b < slots; ++b) {
      const int more = gained[row * slots + b];
      if (more == 0 || index_of(inside, KeyframeId(b)) >= 0) continue;
      const int before = shared_before(snapshot, inside[row], KeyframeId(b));
      if (before < min_shared && before + more >= min_shared)
        connections.push_back({inside[row], KeyframeId(b), before + more});
    }
  return connections;
}

std::vector<LoopConnection> find_connections_reference(const Snapshot& snapshot,
                                                       std::span<const KeyframeId> connected,
                                                       const Fusion& fusion, int min_shared) {
  const std::vector<KeyframeId> inside = ascending(connected);
  const Groups groups(snapshot, fusion);
  std::unordered_map<KeyframeId, std::vector<LandmarkId>> added;
  for (const map::NewObservation& o : fusion.observations) added[o.keyframe].push_back(o.landmark);

  std::vector<LoopConnection> connections;
  for (const KeyframeId id : inside) {
    std::map<KeyframeId, int> shared;
    const auto count = [&](LandmarkId landmark) {
      const auto it = groups.changed().find(landmark);
      if (it == groups.changed().end()) {
        for (const map::Observation& o : snapshot.landmark(landmark).observations)
          ++shared[o.keyframe];
        return;
      }
      for (const auto& part : it->second)
        for (const KeyframeId observer : part) ++shared[observer];
    };
    for (const LandmarkId l : snapshot.keyframe(id).landmarks)
      if (l.valid()) count(groups.winner(l));
    for (const LandmarkId l : added[id]) count(l);
    for (const auto& [other, n] : shared)
      if (other != id && n >= min_shared && index_of(inside, other) < 0 &&
          shared_before(snapshot, id, other) < min_shared)
        connections.push_back({id, other, n});
  }
  return connections;
}

}  // namespace fastloop::loop
