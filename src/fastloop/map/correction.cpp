#include "fastloop/map/correction.hpp"

#include <algorithm>
#include <atomic>
#include <mutex>
#include <queue>

#include "fastloop/compute/worker_team.hpp"
#include "fastloop/core/time.hpp"

namespace fastloop::map {
namespace {

using Fault = std::optional<std::string>;

std::string name(auto id) { return std::to_string(id.value()); }

bool is_finite(const NavState& s) {
  return s.T_world_body.is_finite() && s.v_world.allFinite() && s.bias.gyro.allFinite() &&
         s.bias.accel.allFinite() &&
         std::abs(s.T_world_body.rotation.norm() - 1) < 1e-6;
}

/// Motion of a keyframe in the world: new pose = motion * old pose.
SE3 motion_of(const CorrectedState& s) {
  return s.after.T_world_body * s.before.T_world_body.inverse();
}

/// The map as it would be: poses after the correction.
class Corrected {
 public:
  Corrected(const Snapshot& map, const LoopCorrection& c) : map_(map) {
    before_.reserve(map.keyframe_slots());
    for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i)
      before_.push_back(map.T_world_body(KeyframeId(i)));
    after_ = before_;
    for (const CorrectedState& s : c.states) {
      SE3& T = after_[s.keyframe.value()];
      T = motion_of(s) * T;
    }
  }
  const SE3& before(KeyframeId id) const { return before_[id.value()]; }
  const SE3& T_world_body(KeyframeId id) const { return after_[id.value()]; }
  Vector3d p_world(LandmarkId id) const {
    const Landmark& l = map_.landmark(id);
    return T_world_body(l.anchor) * l.p_anchor;
  }

 private:
  const Snapshot& map_;
  std::vector<SE3> before_, after_;  ///< [keyframe slots]
};

/// Reprojection error in pixels of octave 0; large when the camera cannot see the point.
double error_px(const Snapshot& map, const SE3& T_camera_world, const Vector3d& p_world,
                const FeatureSet& f, std::uint32_t keypoint) {
  const Vector3d p = T_camera_world * p_world;
  const Camera& camera = map.rig().left;
  if (!p.allFinite() || !camera.is_projectable(p)) return 1e6;
  const Eigen::Vector2d pixel(f.x[keypoint], f.y[keypoint]);
  return (camera.project(p) - pixel).norm() /
         static_cast<double>(map.scales().scale[f.octave[keypoint]]);
}

double median(std::vector<double>& values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

Fault check_names(const Snapshot& map, const LoopCorrection& c) {
  const auto known = [&](MapId id) { return id.value() < map.maps().size(); };
  if (!known(c.map) || (c.kind == LoopCorrection::Kind::kMerge && !known(c.merged)))
    return "it names a map that does not exist";
  if (c.kind == LoopCorrection::Kind::kMerge && c.map == c.merged)
    return "it merges a map with itself";
  if (c.frame_version != map.frame_version())
    return "the map was corrected since it was computed";
  for (std::size_t i = 0; i < c.states.size(); ++i) {
    const KeyframeId id = c.states[i].keyframe;
    if (id.value() >= map.keyframe_slots()) return "it names keyframe " + name(id) + ", which does not exist";
    if (i > 0 && c.states[i - 1].keyframe >= id) return "its keyframes are not in order";
    const MapId of = map.keyframe(id).map;
    if (of != c.map && (c.kind != LoopCorrection::Kind::kMerge || of != c.merged))
      return "keyframe " + name(id) + " belongs to another map";
  }
  const auto landmark_known = [&](LandmarkId id) { return id.value() < map.landmark_slots(); };
  for (const LandmarkMerge& m : c.merges)
    if (!landmark_known(m.loser) || !landmark_known(m.winner) || m.loser == m.winner)
      return "it merges landmark " + name(m.loser) + " into " + name(m.winner) +
             ", which cannot be";
  for (const NewObservation& o : c.observations) {
    if (!landmark_known(o.landmark)) return "it names landmark " + name(o.landmark) + ", which does not exist";
    if (o.keyframe.value() >= map.keyframe_slots() ||
        (map.contains(o.keyframe) && o.keypoint >= map.keyframe(o.keyframe).landmarks.size()))
      return "it names keypoint " + std::to_string(o.keypoint) + " of keyframe " +
             name(o.keyframe) + ", which does not exist";
  }
  for (const CorrectedPoint& p : c.points)
    if (!landmark_known(p.landmark) || p.anchor.value() >= map.keyframe_slots())
      return "it moves landmark " + name(p.landmark) + ", which does not exist";
  return std::nullopt;
}

Fault check_finite(const LoopCorrection& c) {
  for (const CorrectedState& s : c.states)
    if (!is_finite(s.before) || !is_finite(s.after))
      return "the state of keyframe " + name(s.keyframe) + " is not finite";
  for (const CorrectedPoint& p : c.points)
    if (!p.p_anchor.allFinite()) return "landmark " + name(p.landmark) + " is not finite";
  if (c.kind != LoopCorrection::Kind::kAdjustment && !c.edge.T_a_b.is_finite())
    return "the loop edge is not finite";
  return std::nullopt;
}

Fault check_edge(const Snapshot& map, const LoopCorrection& c, const Corrected& corrected,
                 const CorrectionLimits& limits) {
  for (const KeyframeId id : {c.edge.a, c.edge.b})
    if (id.value() >= map.keyframe_slots()) return "its loop edge ends at a keyframe that does not exist";
  const SE3 T_a_b = corrected.T_world_body(c.edge.a).inverse() * corrected.T_world_body(c.edge.b);
  const double metres = (T_a_b.translation - c.edge.T_a_b.translation).norm();
  const double angle = angle_between(T_a_b, c.edge.T_a_b);
  if (!(metres <= limits.max_edge_error_m) || !(angle <= limits.max_edge_error_rad)) {
    char text[120];
    std::snprintf(text, sizeof text,
                  "corrected poses contradict the loop edge by %.2f m and %.1f degrees", metres,
                  angle * 180 / M_PI);
    return text;
  }
  return std::nullopt;
}

/// What the loop adds must fit the images under the corrected poses.
Fault check_added(const Snapshot& map, const LoopCorrection& c, const Corrected& corrected,
                  const CorrectionLimits& limits, const Executor& executor) {
  std::atomic<std::size_t> total = 0, good = 0;
  const auto fits = [&](LandmarkId landmark, KeyframeId keyframe, std::uint32_t keypoint) {
    const SE3 T_world_camera = corrected.T_world_body(keyframe) * map.rig().T_body_left;
    return error_px(map, T_world_camera.inverse(), corrected.p_world(landmark),
                    *map.keyframe(keyframe).data->features,
                    keypoint) <= limits.observation_gate_px;
  };
  const std::size_t joined = c.merges.size();
  executor.for_ranges(joined + c.observations.size(), 128, [&](std::size_t begin, std::size_t end) {
    std::size_t seen = 0, fitting = 0;
    for (; begin < end; ++begin) {
      if (begin < joined) {
        const LandmarkMerge& m = c.merges[begin];
        if (!map.contains(m.loser) || !map.contains(m.winner)) continue;
        const Observation& o = map.landmark(m.loser).observations.back();
        fitting += fits(m.winner, o.keyframe, o.keypoint);
      } else {
        const NewObservation& o = c.observations[begin - joined];
        if (!map.contains(o.landmark) || !map.contains(o.keyframe)) continue;
        fitting += fits(o.landmark, o.keyframe, o.keypoint);
      }
      ++seen;
    }
    total += seen;
    good += fitting;
  });
  if (2 * good < total)
    return "only " + std::to_string(good) + " of " + std::to_string(total) +
           " joined observations fit the corrected poses";
  return std::nullopt;
}

/// Errors of about `samples` of a keyframe's landmarks that are anchored elsewhere.
void sample_errors(const Snapshot& map, KeyframeId id, const Corrected& corrected,
                   std::size_t samples, std::vector<double>& before, std::vector<double>& after) {
  const Keyframe& k = map.keyframe(id);
  const FeatureSet& f = *k.data->features;
  const SE3& T_body_left = map.rig().T_body_left;
  const SE3 was = (corrected.before(id) * T_body_left).inverse();
  const SE3 is = (corrected.T_world_body(id) * T_body_left).inverse();
  // Neighbouring keyframes see the same landmarks: each begins at another keypoint.
  const std::size_t step = std::max<std::size_t>(1, k.landmarks.size() / samples);
  for (std::size_t i = id.value() % step; i < k.landmarks.size(); i += step) {
    if (!k.landmarks[i].valid()) continue;
    const Landmark& l = map.landmark(k.landmarks[i]);
    if (l.anchor == id) continue;
    const auto keypoint = static_cast<std::uint32_t>(i);
    before.push_back(error_px(map, was, corrected.before(l.anchor) * l.p_anchor, f, keypoint));
    after.push_back(error_px(map, is, corrected.T_world_body(l.anchor) * l.p_anchor, f, keypoint));
  }
}

/// Observations across keyframes must fit about as well as before: a correction bends the map, it
/// does not tear it.
Fault check_growth(const Snapshot& map, const LoopCorrection& c, const Corrected& corrected,
                   const CorrectionLimits& limits, const Executor& executor) {
  // The median of a thousand is that of all within some percent; every keyframe takes part as
  // long as there are not more of them.
  constexpr std::size_t kSamples = 1024;
  const std::size_t each = std::clamp<std::size_t>(kSamples / std::max<std::size_t>(1, c.states.size()), 1, 16);
  const std::size_t stride = c.states.size() / kSamples + 1;
  std::vector<double> before, after;
  std::mutex mutex;
  executor.for_ranges(c.states.size(), 32, [&](std::size_t begin, std::size_t end) {
    std::vector<double> was, is;
    for (; begin < end; ++begin)
      if (begin % stride == 0 && map.contains(c.states[begin].keyframe))
        sample_errors(map, c.states[begin].keyframe, corrected, each, was, is);
    const std::lock_guard lock(mutex);
    before.insert(before.end(), was.begin(), was.end());
    after.insert(after.end(), is.begin(), is.end());
  });
  if (before.empty()) return std::nullopt;
  const double was = median(before), is = median(after);
  if (is > std::max(limits.growth_floor_px, was) * limits.max_growth) {
    char text[120];
    std::snprintf(text, sizeof text, "the median reprojection error would grow from %.2f to %.2f px",
                  was, is);
    return text;
  }
  return std::nullopt;
}

/// Whether the spanning tree alone joins every moved keyframe to an end of the loop: the usual case,
/// and quick to see. Parents are older than their children, but for merged maps.
bool tree_connects(const Snapshot& map, const LoopCorrection& c) {
  std::vector<KeyframeId> root(map.keyframe_slots());
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
    const KeyframeId id(i), parent = map.keyframe(id).parent;
    root[i] = map.contains(id) && parent < id && map.contains(parent) ? root[parent.value()] : id;
  }
  return std::all_of(c.states.begin(), c.states.end(), [&](const CorrectedState& s) {
    const KeyframeId r = root[s.keyframe.value()];
    return !map.contains(s.keyframe) || r == root[c.edge.a.value()] || r == root[c.edge.b.value()];
  });
}

/// Every moved keyframe must hang together with an end of the loop.
Fault check_connected(const Snapshot& map, const LoopCorrection& c) {
  if (tree_connects(map, c)) return std::nullopt;
  std::vector<std::uint8_t> reached(map.keyframe_slots(), 0);
  std::queue<KeyframeId> queue;
  const auto visit = [&](KeyframeId id) {
    if (id.valid() && id.value() < reached.size() && !reached[id.value()]) {
      reached[id.value()] = 1;
      queue.push(id);
    }
  };
  std::vector<std::vector<KeyframeId>> children(map.keyframe_slots());
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
    const KeyframeId parent = map.keyframe(KeyframeId(i)).parent;
    if (map.contains(KeyframeId(i)) && map.contains(parent))
      children[parent.value()].push_back(KeyframeId(i));
  }
  visit(c.edge.a);
  visit(c.edge.b);
  while (!queue.empty()) {
    const KeyframeId id = queue.front();
    queue.pop();
    if (!map.contains(id)) continue;
    const Keyframe& k = map.keyframe(id);
    visit(k.parent);
    // Neighbours in time hold together by what the IMU measured between them.
    if (k.imu_from_previous) visit(k.previous);
    if (map.contains(k.next) && map.keyframe(k.next).imu_from_previous) visit(k.next);
    for (const KeyframeId child : children[id.value()]) visit(child);
    for (const CovisibilityEdge& e : map.covisible(id)) visit(e.keyframe);
  }
  for (const CorrectedState& s : c.states)
    if (map.contains(s.keyframe) && !reached[s.keyframe.value()])
      return "keyframe " + name(s.keyframe) + " would be moved without a path to the loop";
  return std::nullopt;
}

/// What one keyframe is subject to. `state` is null for one that arrived since.
struct Motion {
  KeyframeId keyframe;
  SE3 T_new_old;
  const CorrectedState* state;
};

/// Motion of every live keyframe of the corrected maps, ascending.
std::vector<Motion> motions(const Map& map, const LoopCorrection& c) {
  std::vector<Motion> all;
  all.reserve(map.num_keyframes());
  auto named = c.states.begin();
  const KeyframeId newest = c.states.empty() ? KeyframeId(0) : c.states.back().keyframe;
  std::vector<std::optional<SE3>> latest(map.maps().size());  // over removed keyframes, too
  for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
    const KeyframeId id(i);
    const MapId of = map.keyframe(id).map;
    if (of != c.map && (c.kind != LoopCorrection::Kind::kMerge || of != c.merged)) continue;
    std::optional<SE3>& motion = latest[of.value()];
    if (named != c.states.end() && named->keyframe == id) {
      motion = motion_of(*named);
      if (map.contains(id)) all.push_back({id, *motion, &*named});
      ++named;
    } else if (id > newest && map.contains(id) && motion) {
      all.push_back({id, *motion, nullptr});
    }
  }
  return all;
}

NavState moved(const NavState& now, const Motion& m) {
  NavState s = now;
  s.T_world_body = m.T_new_old * now.T_world_body;
  s.v_world = m.T_new_old.rotation * now.v_world;
  if (m.state) {
    const NavState &before = m.state->before, &after = m.state->after;
    s.v_world += after.v_world - m.T_new_old.rotation * before.v_world;
    s.bias.gyro += after.bias.gyro - before.bias.gyro;
    s.bias.accel += after.bias.accel - before.bias.accel;
  }
  return s;
}

}  // namespace

Fault find_fault(const Snapshot& map, const LoopCorrection& c, const CorrectionLimits& limits,
                 const Executor& executor) {
  if (Fault fault = check_names(map, c)) return fault;
  if (Fault fault = check_finite(c)) return fault;
  const Corrected corrected(map, c);
  if (c.kind != LoopCorrection::Kind::kAdjustment) {
    if (Fault fault = check_edge(map, c, corrected, limits)) return fault;
    if (Fault fault = check_added(map, c, corrected, limits, executor)) return fault;
    if (Fault fault = check_connected(map, c)) return fault;
  }
  return c.points.empty() ? check_growth(map, c, corrected, limits, executor) : std::nullopt;
}

CorrectionOutcome apply_correction(Map& map, const LoopCorrection& c,
                                   const CorrectionLimits& limits, const Executor& executor) {
  std::optional<WorkerTeam::Shift> shift;
  if (!executor.sequential()) shift.emplace();
  CorrectionOutcome outcome;
  const Stopwatch watch;
  const Fault fault = find_fault(map, c, limits, executor);
  outcome.times.check_ms = watch.elapsed_ms();
  if (fault) {
    outcome.reason = *fault;
    return outcome;
  }
  const std::vector<Motion> motion = motions(map, c);
  std::vector<std::pair<KeyframeId, NavState>> states;
  states.reserve(motion.size());
  for (const Motion& m : motion)
    states.emplace_back(m.keyframe, moved(map.keyframe(m.keyframe).state, m));
  map.set_states(executor, states);
  outcome.moved = motion.size();
  if (!motion.empty()) outcome.T_new_old = motion.back().T_new_old;
  outcome.times.poses_ms = watch.elapsed_ms() - outcome.times.check_ms;
  for (const CorrectedPoint& p : c.points)
    if (map.contains(p.landmark) && map.landmark(p.landmark).anchor == p.anchor)
      map.set_p_anchor(p.landmark, p.p_anchor);
  const Map::FusionOutcome fused = map.fuse_landmarks(executor, c.merges, c.observations);
  outcome.merged = fused.merged;
  outcome.observed = fused.observed;
  if (c.kind == LoopCorrection::Kind::kMerge)
    map.merge_maps(c.merged, c.map, c.edge.a);
  if (c.kind != LoopCorrection::Kind::kAdjustment) {
    map.add_loop_edge(c.edge);
    map.note_frame_change();
  }
  outcome.applied = true;
  outcome.times.covisibility_ms = fused.covisibility_ms;
  outcome.times.landmarks_ms = watch.elapsed_ms() - outcome.times.check_ms -
                               outcome.times.poses_ms - fused.covisibility_ms;
  return outcome;
}

}  // namespace fastloop::map
