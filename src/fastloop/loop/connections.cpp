#include "fastloop/loop/connections.hpp"

#include <algorithm>
#include <map>
#include <numeric>
#include <tuple>
#include <unordered_map>

#include "fastloop/loop/flat_index.hpp"

namespace fastloop::loop {
namespace {

using map::LoopConnection;
using map::Snapshot;

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

/// One observer of a group of landmarks that become one.
struct Observer {
  std::uint32_t index;  ///< among the connected keyframes, or among all others
  std::int32_t part;    ///< which landmark or new observation of its group it comes from
};

/// Observers of all groups, those among the connected keyframes and the others apart.
struct Observers {
  std::vector<Observer> inside, outside;
  struct End {
    std::size_t inside, outside;
  };
  std::vector<End> groups;  ///< where each one's observers end
};

/// Part of a group: a landmark, or one keyframe that sees it from now on.
struct Part {
  LandmarkId winner, landmark;
  KeyframeId keyframe;
};

/// Parts with the same winner lie together.
std::vector<Part> parts_by_winner(const Fusion& fusion) {
  const std::size_t n = fusion.merges.size() + fusion.observations.size();
  FlatIndex groups(n);
  std::vector<std::uint32_t> group_of, next(n + 1, 0);
  group_of.reserve(n);
  const auto count = [&](LandmarkId winner) {
    group_of.push_back(groups.number_of(winner.value()));
    ++next[group_of.back() + 1];
  };
  for (const map::LandmarkMerge& m : fusion.merges) count(m.winner);
  for (const map::NewObservation& o : fusion.observations) count(o.landmark);
  std::partial_sum(next.begin(), next.end(), next.begin());
  std::vector<Part> parts(n);
  auto group = group_of.begin();
  for (const map::LandmarkMerge& m : fusion.merges)
    parts[next[*group++]++] = {m.winner, m.loser, {}};
  for (const map::NewObservation& o : fusion.observations)
    parts[next[*group++]++] = {o.landmark, {}, o.keyframe};
  return parts;
}

Observers observers_of(const Snapshot& snapshot, std::span<const KeyframeId> inside,
                       const Fusion& fusion, FlatIndex& columns) {
  std::vector<std::int32_t> row_of(snapshot.keyframe_slots(), -1);
  for (std::size_t row = 0; row < inside.size(); ++row)
    row_of[inside[row].value()] = static_cast<std::int32_t>(row);
  Observers observers;
  const auto see = [&](KeyframeId id, std::int32_t part) {
    if (const std::int32_t row = row_of[id.value()]; row >= 0)
      observers.inside.push_back({static_cast<std::uint32_t>(row), part});
    else
      observers.outside.push_back({columns.number_of(id.value()), part});
  };
  const std::vector<Part> parts = parts_by_winner(fusion);
  observers.inside.reserve(16 * parts.size());
  observers.outside.reserve(16 * parts.size());
  for (std::size_t i = 0; i < parts.size();) {
    const LandmarkId winner = parts[i].winner;
    std::int32_t part = 0;
    for (const map::Observation& o : snapshot.landmark(winner).observations) see(o.keyframe, part);
    for (; i < parts.size() && parts[i].winner == winner; ++i) {
      ++part;
      if (parts[i].keyframe.valid())
        see(parts[i].keyframe, part);
      else
        for (const map::Observation& o : snapshot.landmark(parts[i].landmark).observations)
          see(o.keyframe, part);
    }
    observers.groups.push_back({observers.inside.size(), observers.outside.size()});
  }
  return observers;
}

}  // namespace

std::vector<LoopConnection> find_connections(const Snapshot& snapshot,
                                             std::span<const KeyframeId> connected,
                                             const Fusion& fusion, int min_shared) {
  const std::vector<KeyframeId> inside = ascending(connected);
  FlatIndex columns(1024);  // of the others
  const Observers observers = observers_of(snapshot, inside, fusion, columns);
  std::vector<int> gained(inside.size() * columns.size(), 0);
  Observers::End begin{0, 0};
  for (const Observers::End end : observers.groups) {
    for (std::size_t i = begin.inside; i < end.inside; ++i) {
      const Observer& from = observers.inside[i];
      int* row = gained.data() + from.index * columns.size();
      for (std::size_t j = begin.outside; j < end.outside; ++j)
        row[observers.outside[j].index] += observers.outside[j].part != from.part;
    }
    begin = end;
  }
  std::vector<LoopConnection> connections;
  for (std::size_t row = 0; row < inside.size(); ++row)
    for (std::size_t column = 0; column < columns.size(); ++column) {
      const int more = gained[row * columns.size() + column];
      if (more == 0) continue;
      const KeyframeId other(columns.key(column));
      const int before = snapshot.num_shared(inside[row], other);
      if (before < min_shared && before + more >= min_shared)
        connections.push_back({inside[row], other, before + more});
    }
  std::sort(connections.begin(), connections.end(), [](const auto& x, const auto& y) {
    return std::tie(x.a, x.b) < std::tie(y.a, y.b);
  });
  return connections;
}

std::vector<LoopConnection> find_connections_reference(const Snapshot& snapshot,
                                                       std::span<const KeyframeId> connected,
                                                       const Fusion& fusion, int min_shared) {
  const std::vector<KeyframeId> inside = ascending(connected);
  // As published: the neighbours of every connected keyframe are counted before the fusion and again
  // after it, and the new ones are those that were none before.
  std::vector<std::map<KeyframeId, int>> before;
  for (const KeyframeId id : inside) {
    auto& shared = before.emplace_back();
    for (const LandmarkId l : snapshot.keyframe(id).landmarks)
      if (l.valid())
        for (const map::Observation& o : snapshot.landmark(l).observations) ++shared[o.keyframe];
  }
  const Groups groups(snapshot, fusion);
  std::unordered_map<KeyframeId, std::vector<LandmarkId>> added;
  for (const map::NewObservation& o : fusion.observations) added[o.keyframe].push_back(o.landmark);

  std::vector<LoopConnection> connections;
  for (std::size_t k = 0; k < inside.size(); ++k) {
    const KeyframeId id = inside[k];
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
    for (const auto& [other, n] : shared) {
      if (other == id || n < min_shared || index_of(inside, other) >= 0) continue;
      const auto was = before[k].find(other);
      if (was == before[k].end() || was->second < min_shared) connections.push_back({id, other, n});
    }
  }
  return connections;
}

}  // namespace fastloop::loop
