#include "fastloop/sim/motion.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/random.hpp"

namespace fastloop::sim {
namespace {

constexpr double kRestSeconds = 0.5, kRampUpSeconds = 2, kRampDownSeconds = 3;
constexpr double kShortestWithStop = 10;  ///< shorter motions do not slow down at their end
constexpr double kKnotSeconds = 0.1;

/// How a world is walked.
struct Style {
  double cruise, fastest;         ///< m / s along the floor path
  double radius, smooth;          ///< of corners, metres
  double height, height_change;   ///< metres
  double sway;                    ///< factor on hand-held sway
  double look;                    ///< factor on looking around
  double pitch;                   ///< mean, radians, positive looks down
};

Style style(WorldKind kind) {
  switch (kind) {
    case WorldKind::kRoom: return {0.85, 1.0, 1.25, 0.3, 1.45, 0.35, 1.0, 1.0, 0.05};
    case WorldKind::kHall: return {1.12, 1.2, 2.5, 0.8, 2.6, 0.8, 1.0, 1.2, 0.05};
    case WorldKind::kCorridor: return {1.36, 1.38, 1.5, 0.5, 1.5, 0.06, 0.6, 0.7, 0.0};
    case WorldKind::kCampus: return {3.8, 4.2, 7.0, 2.0, 2.2, 0.4, 0.8, 0.8, -0.06};
    case WorldKind::kRing:
    case WorldKind::kCloister: return {1.1, 1.25, 4.0, 0.8, 1.5, 0.05, 0.5, 0.5, 0.0};
  }
  throw InvalidArgument("unknown world");
}

double smooth_step(double x) {
  x = std::clamp(x, 0.0, 1.0);
  return x * x * x * (10 + x * (6 * x - 15));
}

/// 0 at rest, 1 in full motion.
double activity(double t, double seconds) {
  const double start = smooth_step((t - kRestSeconds) / kRampUpSeconds);
  if (seconds < kShortestWithStop) return start;
  return start * smooth_step((seconds - t) / kRampDownSeconds);
}

/// Sum of sinusoids with random phases, 0 at rest thanks to the caller's activity factor.
struct Sway {
  struct Term {
    double amplitude, frequency_hz, phase;
  };
  std::vector<Term> terms;

  Sway(Random& random, std::initializer_list<std::array<double, 2>> amplitude_frequency) {
    for (const auto& [amplitude, frequency] : amplitude_frequency)
      terms.push_back({amplitude, frequency * random.uniform(0.93, 1.07),
                       random.uniform(0, 2 * M_PI)});
  }
  double operator()(double t) const {
    double sum = 0;
    for (const Term& a : terms)
      sum += a.amplitude * std::sin(2 * M_PI * a.frequency_hz * t + a.phase);
    return sum;
  }
};

/// Arc length over time: ramps at the ends, constant speed between, a whole number of laps if that is
/// close to the usual speed.
class Progress {
 public:
  Progress(const Style& style, double lap_m, double seconds) : seconds_(seconds) {
    const int n = static_cast<int>(std::ceil(seconds / kStep)) + 2;
    table_.assign(n, 0);
    for (int i = 1; i < n; ++i) {
      const double middle = (i - 0.5) * kStep;
      table_[i] = table_[i - 1] + activity(middle, seconds) * kStep;
    }
    const double effective = std::max((*this)(seconds), 1e-3);
    double speed = style.cruise;
    const double laps = std::round(style.cruise * effective / lap_m);
    const double whole = laps * lap_m / effective;
    if (whole > 0.7 * style.cruise && whole <= style.fastest) speed = whole;
    for (double& s : table_) s *= speed;
  }
  double operator()(double t) const {
    const double x = std::clamp(t, 0.0, seconds_) / kStep;
    const auto i = std::min(static_cast<std::size_t>(x), table_.size() - 2);
    return table_[i] + (x - static_cast<double>(i)) * (table_[i + 1] - table_[i]);
  }

 private:
  static constexpr double kStep = 0.005;
  double seconds_;
  std::vector<double> table_;
};

Eigen::Quaterniond from_angles(double yaw, double pitch, double roll) {
  return Eigen::Quaterniond(Eigen::AngleAxisd(yaw, Vector3d::UnitZ()) *
                            Eigen::AngleAxisd(pitch, Vector3d::UnitY()) *
                            Eigen::AngleAxisd(roll, Vector3d::UnitX()));
}

void append_rounded_corner(std::vector<Eigen::Vector2d>& points, const Eigen::Vector2d& before,
                           const Eigen::Vector2d& corner, const Eigen::Vector2d& after,
                           double radius) {
  const Eigen::Vector2d in = (corner - before).normalized(), out = (after - corner).normalized();
  const double turn = std::atan2(in.x() * out.y() - in.y() * out.x(), in.dot(out));
  const double setback = radius * std::tan(std::abs(turn) / 2);
  const Eigen::Vector2d start = corner - setback * in;
  const Eigen::Vector2d inward(-in.y() * (turn > 0 ? 1 : -1), in.x() * (turn > 0 ? 1 : -1));
  const Eigen::Vector2d centre = start + radius * inward;
  constexpr int kSteps = 24;
  for (int i = 0; i <= kSteps; ++i)
    points.push_back(centre + Eigen::Rotation2Dd(turn * i / kSteps) * (start - centre));
}

}  // namespace

WorldKind parse_world_kind(const std::string& name) {
  for (const WorldKind k :
       {WorldKind::kRoom, WorldKind::kHall, WorldKind::kCorridor, WorldKind::kCampus,
        WorldKind::kRing, WorldKind::kCloister})
    if (to_string(k) == name) return k;
  throw InvalidArgument("unknown world '" + name + "' (expected room, hall, corridor, campus, ring or cloister)");
}

std::string to_string(WorldKind kind) {
  switch (kind) {
    case WorldKind::kRoom: return "room";
    case WorldKind::kHall: return "hall";
    case WorldKind::kCorridor: return "corridor";
    case WorldKind::kCampus: return "campus";
    case WorldKind::kRing: return "ring";
    case WorldKind::kCloister: return "cloister";
  }
  return "?";
}

double default_seconds(WorldKind kind) {
  switch (kind) {
    case WorldKind::kRoom: return 40;
    case WorldKind::kHall: return 90;
    case WorldKind::kCorridor: return 160;
    case WorldKind::kCampus: return 300;
    case WorldKind::kRing: return 64;
    case WorldKind::kCloister: return 120;
  }
  return 40;
}

FloorPath::FloorPath(const std::vector<Eigen::Vector2d>& corners, double corner_radius_m) {
  const std::size_t n = corners.size();
  if (n < 3) throw InvalidArgument("a floor path needs at least 3 corners");
  // Start in the middle of the first side.
  points_.push_back(0.5 * (corners[0] + corners[1]));
  for (std::size_t i = 1; i <= n; ++i)
    append_rounded_corner(points_, corners[i - 1], corners[i % n], corners[(i + 1) % n],
                          corner_radius_m);
  points_.push_back(points_.front());
  s_.push_back(0);
  for (std::size_t i = 1; i < points_.size(); ++i)
    s_.push_back(s_.back() + (points_[i] - points_[i - 1]).norm());
  length_ = s_.back();
}

Eigen::Vector2d FloorPath::raw(double s_m) const {
  const double s = s_m - length_ * std::floor(s_m / length_);
  const auto it = std::upper_bound(s_.begin() + 1, s_.end() - 1, s);
  const std::size_t i = it - s_.begin();
  const double span = s_[i] - s_[i - 1];
  const double f = span > 0 ? (s - s_[i - 1]) / span : 0;
  return points_[i - 1] + f * (points_[i] - points_[i - 1]);
}

Eigen::Vector2d FloorPath::position(double s_m, double smooth_m) const {
  constexpr int kHalf = 6;
  Eigen::Vector2d sum = Eigen::Vector2d::Zero();
  double total = 0;
  for (int i = -kHalf; i <= kHalf; ++i) {
    const double weight = 1 + std::cos(M_PI * i / (kHalf + 1));
    sum += weight * raw(s_m + smooth_m * i / kHalf);
    total += weight;
  }
  return sum / total;
}

std::vector<Eigen::Vector2d> corridor_corners() { return {{-34, -20}, {34, -20}, {34, 20}, {-34, 20}}; }

FloorPath floor_path(WorldKind kind) {
  const double radius = style(kind).radius;
  switch (kind) {
    case WorldKind::kRoom: return FloorPath({{-2.3, -1.5}, {2.3, -1.5}, {2.3, 1.5}, {-2.3, 1.5}}, radius);
    case WorldKind::kHall:
      return FloorPath({{-5.8, -3.1}, {-1.5, -3.1}, {2, -3.7}, {5.8, -3.1}, {5.8, 3.1}, {1, 2.5}, {-5.8, 3.1}},
                       radius);
    case WorldKind::kCorridor: return FloorPath(corridor_corners(), radius);
    case WorldKind::kRing:
    case WorldKind::kCloister: {
      std::vector<Eigen::Vector2d> corners;
      for (int i = 0; i < kRingBays; ++i) {
        const double angle = 2 * M_PI * (i + 0.5) / kRingBays;
        corners.emplace_back(kRingRadius * std::cos(angle), kRingRadius * std::sin(angle));
      }
      return FloorPath(corners, radius);
    }
    case WorldKind::kCampus: {
      const double p = kCampusPitch;  // figure of eight: the middle street is walked twice per lap
      return FloorPath({{0, 0}, {0, p}, {-p, p}, {-p, 0}, {0, 0}, {0, p}, {p, p}, {p, 0}}, radius);
    }
  }
  throw InvalidArgument("unknown world");
}

Trajectory make_motion(WorldKind kind, double seconds, std::uint64_t seed,
                       const Eigen::Quaterniond& carrier_from_body) {
  if (!std::isfinite(seconds) || seconds <= 0) throw InvalidArgument("seconds must be positive");
  const Style walk = style(kind);
  const FloorPath path = floor_path(kind);
  const Progress progress(walk, path.length(), seconds);
  Random random(mix64(seed) ^ 0x3071);
  const Sway lateral(random, {{0.06, 0.83}, {0.03, 1.37}, {0.08, 0.13}});
  const Sway vertical(random, {{0.07, 0.67}, {0.02, 1.75}});
  const Sway yaw(random, {{0.34, 0.10}, {0.04, 0.71}});
  const Sway pitch(random, {{0.10, 0.21}, {0.035, 0.93}});
  const Sway roll(random, {{0.09, 0.29}, {0.03, 1.13}});
  const double height_phase = random.uniform(0, 2 * M_PI);

  const auto control_pose = [&](double t) {
    const double s = progress(t), active = activity(t, seconds);
    const Eigen::Vector2d here = path.position(s, walk.smooth);
    const Eigen::Vector2d ahead =
        path.position(s + 0.4, walk.smooth) - path.position(s - 0.4, walk.smooth);
    const double heading = std::atan2(ahead.y(), ahead.x());
    const Eigen::Vector2d side(-std::sin(heading), std::cos(heading));
    const Eigen::Vector2d xy = here + active * walk.sway * lateral(t) * side;
    const double lap_angle = 2 * M_PI * s / path.length();
    const double z = walk.height + walk.height_change * std::sin(2 * lap_angle + height_phase) +
                     active * walk.sway * vertical(t);
    const Eigen::Quaterniond R_world_carrier =
        from_angles(heading + active * walk.look * yaw(t), walk.pitch + active * walk.look * pitch(t),
                    active * walk.look * roll(t));
    return SE3(R_world_carrier * carrier_from_body, Vector3d(xy.x(), xy.y(), z));
  };
  // A little longer than asked for, so that the last IMU sample has its full support.
  const int controls = static_cast<int>(std::ceil(seconds / kKnotSeconds)) + 8;
  std::vector<SE3> control;
  for (int j = 0; j < controls; ++j) control.push_back(control_pose((j - 2) * kKnotSeconds));
  return Trajectory(0, kKnotSeconds, std::move(control));
}

}  // namespace fastloop::sim
