#include "fastloop/sim/map_worlds.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "fastloop/compute/executor.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/sim/map_route.hpp"
#include "fastloop/sim/map_views.hpp"
#include "fastloop/sim/rig.hpp"

namespace fastloop::sim {
namespace {

constexpr int kTurns = 3;  // of the ring on which a point can appear: before, first, again
constexpr std::size_t kMinObservers = 3;  // of a landmark
constexpr double kSamePlace = 3;          // metres between keyframes that see the same place

StereoRig make_stereo_rig(bool fisheye) {
  const Calibration calibration = make_rig(fisheye ? CameraKind::kFisheye : CameraKind::kPinhole);
  StereoRig rig;
  rig.left = calibration.cameras[0].camera;
  rig.right = calibration.cameras[1].camera;
  rig.T_body_left = calibration.cameras[0].T_body_camera;
  rig.T_right_left = calibration.cameras[1].T_body_camera.inverse() * rig.T_body_left;
  rig.baseline_m = rig.T_right_left.translation.norm();
  rig.kind = StereoRig::Kind::kGeneral;
  if (fisheye) return rig;
  // The pair after rectification, in round numbers.
  rig.kind = StereoRig::Kind::kRectified;
  rig.left = {CameraModel::kPinhole, 752, 480, 435.2, 435.2, 367.4, 252.2, {}};
  rig.right = rig.left;
  rig.T_right_left = SE3(Eigen::Quaterniond::Identity(), Vector3d(-rig.baseline_m, 0, 0));
  return rig;
}

/// Points along all roads, and where each run meets them.
class World {
 public:
  World(const MapWorldOptions& options, const RoadMap& roads, const ViewModel& views,
        const Eigen::Quaterniond& R_carrier_body, double step) {
    const SE3 T_carrier_body(R_carrier_body, Vector3d::Zero());
    const double density = options.features * options.landmark_share /
                           (views.mean_sightings(T_carrier_body, step) * step);
    for (std::size_t road = 0; road < roads.num_roads(); ++road) {
      first_.push_back(points_.size());
      const double length = roads.length(road);
      const auto count = static_cast<std::size_t>(density * length);
      points_.resize(points_.size() + count);
      const auto make = [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
          Random random(mix64(options.seed + 0x5851f42dull * road) + i);
          const double s =
              length * (static_cast<double>(i) + random.uniform()) / static_cast<double>(count);
          points_[first_.back() + i] =
              views.make_point(roads.T_world_carrier(road, s) * T_carrier_body, s, random);
        }
      };
      Executor::cpu().for_ranges(count, 256, make);
    }
    first_.push_back(points_.size());
  }

  const std::vector<WorldPoint>& points() const { return points_; }
  std::size_t slots_of_run() const { return (kTurns - 1) * first_[1] + points_.size(); }
  std::uint32_t point_of_slot(std::size_t slot) const {
    slot %= slots_of_run();
    const std::size_t turns = kTurns * first_[1];
    return static_cast<std::uint32_t>(slot < turns ? slot % first_[1] : slot - turns + first_[1]);
  }

  /// Appearances of points along a run, in the order of the way. A stretch of the ring that is
  /// walked again on the same turn shows the same slots; a turn later it shows others.
  std::vector<ViewModel::Appearance> appearances(const Run& run, const RoadMap& roads,
                                                 std::size_t first_slot) const {
    std::vector<ViewModel::Appearance> result;
    for (const RoutePiece& piece : run.pieces) {
      const bool ring = piece.road == 0;
      for (int turn = -1; turn < kTurns - 1; ++turn) {
        if (!ring && turn != 0) continue;
        const double shift = ring ? turn * roads.circuit() : 0;
        for (std::size_t i = first_at(piece.road, piece.begin - shift);
             i < first_[piece.road + 1] && points_[i].home + shift < piece.end; ++i) {
          const std::size_t slot =
              first_slot + (ring ? static_cast<std::size_t>(turn + 1) * first_[1] + i
                                 : (kTurns - 1) * first_[1] + i);
          result.push_back({piece.at + points_[i].home + shift - piece.begin,
                            static_cast<std::uint32_t>(i), static_cast<std::uint32_t>(slot)});
        }
      }
    }
    return result;
  }

 private:
  std::size_t first_at(std::size_t road, double s) const {
    const auto begin = points_.begin() + static_cast<std::ptrdiff_t>(first_[road]);
    const auto end = points_.begin() + static_cast<std::ptrdiff_t>(first_[road + 1]);
    const auto at = std::lower_bound(
        begin, end, s, [](const WorldPoint& p, double value) { return p.home < value; });
    return static_cast<std::size_t>(at - points_.begin());
  }

  std::vector<WorldPoint> points_;
  std::vector<std::size_t> first_;  ///< [roads + 1] points of a road are consecutive
};

struct Sighting {
  KeyframeId keyframe;
  std::uint32_t keypoint;
};

class MapMaker {
 public:
  explicit MapMaker(const MapWorldOptions& options)
      : options_(options),
        rig_(make_stereo_rig(options.fisheye)),
        R_carrier_body_(carrier_from_body(
            make_rig(options.fisheye ? CameraKind::kFisheye : CameraKind::kPinhole))),
        sizes_(route_sizes(options)),
        roads_(sizes_),
        views_(options, rig_, sizes_.window),
        world_(options, roads_, views_, R_carrier_body_, sizes_.step),
        runs_(make_runs(options, sizes_, roads_, R_carrier_body_)),
        result_{map::Map(rig_, PyramidScales()), {}, {}, {}, {}, {}} {}

  SimulatedMap make() && {
    for (std::size_t r = 0; r < runs_.size(); ++r) add_run(r);
    for (std::uint32_t i = 0; i < result_.map.keyframe_slots(); ++i)
      result_.map.attach_to_spanning_tree(KeyframeId(i));
    add_loop_edges();
    find_matches();
    return std::move(result_);
  }

 private:
  void add_run(std::size_t r) {
    map::Map& map = result_.map;
    const MapId id = map.start_map();
    map.mutable_info(id).imu_initialized = options_.inertial;
    map.mutable_info(id).imu_refinements = options_.inertial ? 2 : 0;
    const Run& run = runs_[r];
    const auto appearances = world_.appearances(run, roads_, r * world_.slots_of_run());
    const auto first = static_cast<std::uint32_t>(stops_.size());
    std::vector<std::shared_ptr<FeatureSet>> features(run.stops.size());
    std::vector<std::vector<ViewModel::SlotKeypoint>> keypoints(run.stops.size());
    Executor::cpu().for_ranges(run.stops.size(), 4, [&](std::size_t begin, std::size_t end) {
      for (std::size_t i = begin; i < end; ++i)
        std::tie(features[i], keypoints[i]) =
            views_.view(run.stops[i], near(appearances, run.stops[i].way), world_.points(),
                        Random(mix64(options_.seed + 0x2545f491ull) + first + i));
    });
    for (std::size_t i = 0; i < run.stops.size(); ++i)
      add_keyframe(id, r, run.stops[i], std::move(features[i]));
    add_landmarks(first, keypoints, r * world_.slots_of_run());
  }

  std::span<const ViewModel::Appearance> near(const std::vector<ViewModel::Appearance>& appearances,
                                              double way) const {
    const auto at = [&](double value) {
      return std::lower_bound(appearances.begin(), appearances.end(), value,
                              [](const ViewModel::Appearance& a, double v) { return a.way < v; });
    };
    return {at(way - sizes_.window), at(way + sizes_.window)};
  }

  void add_keyframe(MapId id, std::size_t run, const RouteStop& stop,
                    std::shared_ptr<const FeatureSet> features) {
    auto data = std::make_shared<map::KeyframeData>();
    const auto number = static_cast<std::uint32_t>(stops_.size());
    // Keyframes are some frames of a stream; between two runs some seconds are lost.
    data->frame = FrameId(5 * number + 50 * static_cast<std::uint32_t>(run));
    data->stamp_ns = from_seconds(sizes_.step / kSpeed * number + 5.0 * static_cast<double>(run));
    data->features = std::move(features);
    NavState state;
    state.T_world_body = stop.T_map_body;
    state.v_world = stop.v_map;
    result_.map.add_keyframe(id, std::move(data), state, nullptr);
    result_.truth.push_back(stop.T_world_body);
    stops_.push_back(stop);
  }

  /// One landmark for every slot that enough keyframes see.
  void add_landmarks(std::uint32_t first_keyframe,
                     const std::vector<std::vector<ViewModel::SlotKeypoint>>& keypoints,
                     std::size_t first_slot) {
    std::vector<std::uint32_t> start(world_.slots_of_run() + 1, 0);
    for (const auto& of_keyframe : keypoints)
      for (const auto& k : of_keyframe) ++start[k.slot - first_slot + 1];
    std::partial_sum(start.begin(), start.end(), start.begin());
    std::vector<Sighting> sightings(start.back());
    std::vector<std::uint32_t> next(start.begin(), start.end() - 1);
    for (std::uint32_t i = 0; i < keypoints.size(); ++i)
      for (const auto& k : keypoints[i])
        sightings[next[k.slot - first_slot]++] = {KeyframeId(first_keyframe + i), k.keypoint};
    for (std::size_t slot = 0; slot + 1 < start.size(); ++slot) {
      const std::span<const Sighting> seen(sightings.data() + start[slot],
                                           start[slot + 1] - start[slot]);
      if (seen.size() >= kMinObservers) add_landmark(world_.point_of_slot(slot), seen);
    }
  }

  /// Mapped through the drift of the middle one of those that see it, which is what an adjustment
  /// of all of them would come to.
  void add_landmark(std::uint32_t point, std::span<const Sighting> seen) {
    map::Map& map = result_.map;
    const RouteStop& middle = stops_[seen[seen.size() / 2].keyframe.value()];
    const Vector3d p_body = middle.T_world_body.inverse() * world_.points()[point].p_world;
    const LandmarkId id =
        map.add_landmark(seen[0].keyframe, seen[0].keypoint, middle.T_map_body * p_body);
    for (const Sighting& s : seen.subspan(1)) map.add_observation(id, s.keyframe, s.keypoint);
    map.refresh_landmark(id);
    const auto others = static_cast<std::uint32_t>(seen.size() - 1);
    map.count_visible(id, others, others);
    result_.point_of.push_back(point);
  }

  /// Each closed loop joins the middle of its stretch, walked before and after the detour.
  void add_loop_edges() {
    for (std::size_t road = 1; road < roads_.num_roads(); ++road) {
      const double s = roads_.exit_of(road) - 0.5 * sizes_.shared;
      const std::size_t before = nearest_on_ring(s, road, false);
      const std::size_t after = nearest_on_ring(s, road, true);
      const SE3 T_a_b = stops_[before].T_map_body.inverse() * stops_[after].T_map_body;
      result_.map.add_loop_edge({KeyframeId(static_cast<std::uint32_t>(before)),
                                 KeyframeId(static_cast<std::uint32_t>(after)), T_a_b});
    }
  }

  /// Keyframe of the ring nearest to `s`, of those before or after detour `road`.
  std::size_t nearest_on_ring(double s, std::size_t road, bool after) const {
    const auto& pieces = runs_[0].pieces;
    const auto detour = std::find_if(pieces.begin(), pieces.end(),
                                     [&](const RoutePiece& p) { return p.road == road; });
    std::size_t best = 0;
    double best_distance = std::numeric_limits<double>::infinity();
    for (std::size_t i = 0; i < runs_[0].stops.size(); ++i) {
      const RouteStop& stop = stops_[i];
      const double distance = std::abs(stop.s - s);
      if (stop.road != 0 || (stop.way > detour->at) != after || distance >= best_distance) continue;
      best = i;
      best_distance = distance;
    }
    return best;
  }

  void find_matches() {
    const std::size_t last = stops_.size() - 1;
    result_.current = KeyframeId(static_cast<std::uint32_t>(last));
    const double s = stops_[last].s - roads_.circuit();
    std::vector<std::pair<double, std::uint32_t>> found;
    for (std::uint32_t i = 0; i < last; ++i) {
      const double distance = std::abs(stops_[i].s - s);
      if (stops_[i].road == 0 && distance < kSamePlace) found.emplace_back(distance, i);
    }
    std::sort(found.begin(), found.end());
    for (const auto& [distance, i] : found) result_.expected_matches.emplace_back(i);
    result_.T_matched_current = result_.truth[found.at(0).second].inverse() * result_.truth[last];
  }

  const MapWorldOptions& options_;
  StereoRig rig_;
  Eigen::Quaterniond R_carrier_body_;
  RouteSizes sizes_;
  RoadMap roads_;
  ViewModel views_;
  World world_;
  std::vector<Run> runs_;
  std::vector<RouteStop> stops_;  ///< [keyframes]
  SimulatedMap result_;
};

}  // namespace

void MapWorldOptions::validate() const {
  const auto require = [](bool fine, const char* message) {
    if (!fine) throw InvalidArgument(message);
  };
  require(keyframes >= 60 && keyframes <= 1'000'000, "keyframes must be in 60 .. 1,000,000");
  require(covisible >= 8 && covisible <= 400, "covisible must be in 8 .. 400");
  require(loops >= 0, "loops must not be negative");
  require(features >= 50 && features <= 20'000, "features must be in 50 .. 20,000");
  require(landmark_share > 0 && landmark_share <= 0.9, "landmark_share must be in (0, 0.9]");
  require(noise_px >= 0 && noise_px < 10, "noise_px must be in [0, 10)");
  require(flipped_bits >= 0 && flipped_bits <= 64, "flipped_bits must be in 0 .. 64");
  require(drift_scale >= 0 && drift_scale <= 10, "drift_scale must be in [0, 10]");
}

SimulatedMap simulate_map(const MapWorldOptions& options) {
  options.validate();
  return MapMaker(options).make();
}

}  // namespace fastloop::sim
