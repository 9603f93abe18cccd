#include "fastloop/sim/map_route.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "fastloop/sim/random.hpp"

namespace fastloop::sim {
namespace {

constexpr double kDriftRatio = 0.003;       // position error per way
constexpr double kMaxYaw = 3 * M_PI / 180;  // at the end
constexpr double kYawPerMetre = 0.01 * M_PI / 180;

Eigen::Quaterniond turn(double yaw) {
  return so3::exp({0, 0, yaw});
}

/// A place `p` of the road is mapped to `p + shift`, its surroundings turned by `yaw` about it.
struct Drift {
  double yaw = 0;
  Vector3d shift = Vector3d::Zero();

  SE3 at(const Vector3d& p) const {
    const Eigen::Quaterniond R = turn(yaw);
    return SE3(R, p + shift - R * p);
  }
};

Drift mix(const Drift& a, const Drift& b, double f) {
  return {a.yaw + f * (b.yaw - a.yaw), a.shift + f * (b.shift - a.shift)};
}

/// The drift seen at another place.
Drift moved(const Drift& d, const Vector3d& from, const Vector3d& to) {
  return {d.yaw, d.at(from) * to - to};
}

/// Slowly varying number about a mean: eight knots, smooth between them.
class SlowNumber {
 public:
  SlowNumber(double mean, double sigma, Random& random) {
    for (double& knot : knots_) knot = mean + sigma * random.normal();
  }
  double operator()(double x) const {  // x in [0, 1]
    const double k = std::clamp(x, 0.0, 1.0) * (kKnots - 1);
    const int i = std::min(static_cast<int>(k), kKnots - 2);
    const double f = k - i;
    return knots_[i] + f * f * (3 - 2 * f) * (knots_[i + 1] - knots_[i]);
  }

 private:
  static constexpr int kKnots = 8;
  std::array<double, kKnots> knots_;
};

/// Drift along the ring: measured motions have slowly varying errors of heading and of length in
/// all directions. Their common factor makes the error at the end what was asked for.
class RingDrift {
 public:
  RingDrift(const RoadMap& roads, double begin, double end, double step, double scale,
            Random random)
      : begin_(begin),
        step_(step),
        yaw_((random.integer(2) ? 1 : -1) * 1.0, 0.6, random),
        forward_(random.normal(), 0.7, random),
        left_(random.normal(), 0.7, random),
        up_(0.5 * random.normal(), 0.3, random),
        samples_(static_cast<std::size_t>((end - begin) / step) + 2) {
    const double way = end - begin, wanted = scale * kDriftRatio * way;
    double low = 0, high = 1;
    if (wanted <= 0) return;
    while (integrate(roads, way, high) < wanted && high < 1e6) high *= 2;
    for (int i = 0; i < 40; ++i) {
      const double middle = 0.5 * (low + high);
      (integrate(roads, way, middle) < wanted ? low : high) = middle;
    }
    integrate(roads, way, high);
  }

  Drift at(double s) const {
    const double k = std::clamp((s - begin_) / step_, 0.0, samples_.size() - 1.000001);
    const auto i = static_cast<std::size_t>(k);
    return mix(samples_[i], samples_[i + 1], k - static_cast<double>(i));
  }

 private:
  /// @return position error at the end
  double integrate(const RoadMap& roads, double way, double factor) {
    const double yaw_rate = std::min(kMaxYaw / way, kYawPerMetre) * factor;
    const double ratio = kDriftRatio * factor;
    SE3 here = roads.T_world_carrier(0, begin_);
    Vector3d mapped = here.translation;
    samples_[0] = {};
    for (std::size_t i = 1; i < samples_.size(); ++i) {
      const double s = begin_ + step_ * static_cast<double>(i);
      const double x = (s - begin_) / way;
      const SE3 next = roads.T_world_carrier(0, s);
      const Vector3d error = ratio * step_ * Vector3d(forward_(x), left_(x), up_(x));
      Drift d = samples_[i - 1];
      mapped += turn(d.yaw) * (next.translation - here.translation + here.rotation * error);
      d.shift = mapped - next.translation;
      d.yaw += yaw_rate * step_ * yaw_(x);
      samples_[i] = d;
      here = next;
    }
    return samples_.back().shift.norm();
  }

  double begin_, step_;
  SlowNumber yaw_, forward_, left_, up_;
  std::vector<Drift> samples_;
};

/// Hand-held motion about the middle of the road.
SE3 wobble(double way) {
  const auto wave = [&](double amplitude, double length) {
    return amplitude * std::sin(2 * M_PI * way / length);
  };
  const double degree = M_PI / 180;
  const Eigen::Quaterniond rotation = so3::exp({0, 0, wave(3 * degree, 23)}) *
                                      so3::exp({wave(2 * degree, 17), wave(2 * degree, 13), 0});
  return SE3(rotation, Vector3d(0, wave(0.15, 37), wave(0.1, 11)));
}

class RunBuilder {
 public:
  RunBuilder(const MapWorldOptions& options, const RouteSizes& sizes, const RoadMap& roads,
             const Eigen::Quaterniond& R_carrier_body)
      : options_(options), sizes_(sizes), roads_(roads), R_carrier_body_(R_carrier_body) {}

  /// The ring from `begin` to `end`, with all detours on the way when `detours`.
  Run build(double begin, double end, bool detours, std::uint64_t stream) const {
    Run run;
    double s = begin - sizes_.window, way = -sizes_.window;
    const auto add = [&](std::size_t road, double from, double to) {
      run.pieces.push_back({road, from, to, way});
      way += to - from;
    };
    for (std::size_t road = 1; detours && road < roads_.num_roads(); ++road) {
      const double exit = roads_.exit_of(road);
      if (exit > s) add(0, s, exit);
      add(road, 0, roads_.length(road));
      add(0, exit - sizes_.shared, exit);
      s = exit;
    }
    add(0, s, end + sizes_.window);
    const double total = way - sizes_.window;
    const RingDrift drift(roads_, begin, end, sizes_.step, options_.drift_scale,
                          Random(mix64(options_.seed) + stream));
    const auto count = static_cast<std::size_t>(std::llround(total / sizes_.step - 0.49)) + 1;
    for (std::size_t i = 0; i < count; ++i)
      run.stops.push_back(stop(run, sizes_.step * static_cast<double>(i), drift));
    return run;
  }

  /// Moves a run's map to a world frame of its own, turned about the vertical, and about the other
  /// axes as well when no IMU says where the vertical is.
  void give_own_world(Run& run) const {
    Random random(mix64(options_.seed ^ 0x70657274u));
    const double tilt = options_.inertial ? 0 : 0.3;
    const double yaw = random.uniform(-M_PI, M_PI);
    const SE3 T_own_world(
        so3::exp({tilt * random.normal(), tilt * random.normal(), 0}) * turn(yaw),
        Vector3d(random.uniform(-20, 20), random.uniform(-20, 20), random.uniform(-2, 2)));
    for (RouteStop& s : run.stops) {
      s.T_map_body = T_own_world * s.T_map_body;
      s.v_map = T_own_world.rotation * s.v_map;
    }
  }

 private:
  Drift drift_on(const RoutePiece& piece, double s, const RingDrift& ring) const {
    if (piece.road == 0) return ring.at(s);
    // From the drift where the ring was left to that where it is met again, by way of a slight
    // error that the closed loop has spread over the detour.
    const double exit = roads_.exit_of(piece.road), entry = exit - sizes_.shared;
    const Vector3d here = roads_.position(piece.road, s);
    const double f = std::clamp(s / (piece.end - piece.begin), 0.0, 1.0);
    Drift d = mix(moved(ring.at(exit), roads_.position(0, exit), here),
                  moved(ring.at(entry), roads_.position(0, entry), here), f * f * (3 - 2 * f));
    Random random(mix64(options_.seed) + 77 * piece.road);
    const Vector3d direction(random.normal(), random.normal(), 0.5 * random.normal());
    const double size = 0.3 * options_.drift_scale * kDriftRatio * (piece.end - piece.begin);
    d.shift += size * std::pow(std::sin(M_PI * f), 2) * direction;
    return d;
  }

  RouteStop stop(const Run& run, double way, const RingDrift& ring) const {
    const auto after =
        std::upper_bound(run.pieces.begin() + 1, run.pieces.end(), way,
                         [](double value, const RoutePiece& piece) { return value < piece.at; });
    const RoutePiece& piece = *(after - 1);
    RouteStop stop;
    stop.way = way;
    stop.road = piece.road;
    stop.s = piece.begin + (way - piece.at);
    const SE3 T_world_carrier = roads_.T_world_carrier(stop.road, stop.s);
    const Drift drift = drift_on(piece, stop.s, ring);
    const SE3 D = drift.at(roads_.position(stop.road, stop.s));
    stop.T_world_body = T_world_carrier * wobble(way) * SE3(R_carrier_body_, Vector3d::Zero());
    stop.T_map_body = D * stop.T_world_body;
    stop.v_map = D.rotation * T_world_carrier.rotation * Vector3d(kSpeed, 0, 0);
    return stop;
  }

  const MapWorldOptions& options_;
  const RouteSizes& sizes_;
  const RoadMap& roads_;
  Eigen::Quaterniond R_carrier_body_;
};

}  // namespace

std::vector<Run> make_runs(const MapWorldOptions& options, const RouteSizes& sizes,
                           const RoadMap& roads, const Eigen::Quaterniond& R_carrier_body) {
  const RunBuilder builder(options, sizes, roads, R_carrier_body);
  const double end = sizes.circuit + sizes.last;
  std::vector<Run> runs;
  if (!options.two_maps) {
    runs.push_back(builder.build(0, end, true, 1));
    runs.back().stops.resize(static_cast<std::size_t>(options.keyframes));
    return runs;
  }
  const double cut = (options.loops > 0 ? 0.85 : 0.5) * sizes.circuit;
  runs.push_back(builder.build(0, cut, true, 1));
  const double left = options.keyframes - static_cast<double>(runs[0].stops.size());
  runs.push_back(builder.build(end - (left - 1) * sizes.step, end, false, 2));
  builder.give_own_world(runs.back());
  return runs;
}

}  // namespace fastloop::sim
