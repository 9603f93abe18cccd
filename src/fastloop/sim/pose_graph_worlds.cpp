#include "fastloop/sim/pose_graph_worlds.hpp"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <unordered_map>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/random.hpp"

namespace fastloop::sim {
namespace {

using optimization::PoseGraphEdge;
using optimization::PoseGraphKind;
constexpr double kStep = 0.7;  // metres between keyframes
constexpr double kTwoPi = 2 * std::numbers::pi;

Vector3d normal3(Random& random, double sigma) {
  const double x = random.normal(), y = random.normal(), z = random.normal();
  return sigma * Vector3d(x, y, z);
}

struct Path {
  std::vector<Vector3d> position;
  std::vector<double> heading;
};

Path loop_path(int n) {
  Path path;
  const int overlap = std::min(20, std::max(6, n / 30));
  const double radius = (n - overlap) * kStep / kTwoPi;
  for (int i = 0; i < n; ++i) {
    const double a = kTwoPi * i / (n - overlap);
    const double r = radius * (1 + 0.12 * std::sin(5 * a) + 0.05 * std::sin(11 * a));
    path.position.emplace_back(r * std::cos(a) - radius, r * std::sin(a), 0.01 * radius * std::sin(3 * a));
  }
  return path;
}

Path laps_path(int n) {
  Path path;
  const int per_lap = n / 4;
  const double radius = per_lap * kStep / kTwoPi;
  for (int i = 0; i < n; ++i) {
    const double a = kTwoPi * i / per_lap;
    const double r = radius * (1 + 0.15 * std::sin(3 * a)) + 0.2 * std::sin(0.37 * i);
    path.position.emplace_back(r * std::cos(a) - radius, r * std::sin(a), 0.02 * radius * std::sin(2 * a));
  }
  return path;
}

Path campus_path(int n) {
  Path path;
  const int circuits = 5, per_circuit = std::max(4, n / (2 * circuits));
  const double radius = per_circuit * kStep / kTwoPi;
  for (int i = 0; i < n; ++i) {
    const double a = kTwoPi * (i % per_circuit) / per_circuit;
    const double direction = kTwoPi * (i / per_circuit % circuits) / circuits;
    const Vector3d centre = radius * Vector3d(std::cos(direction), std::sin(direction), 0);
    const double angle = direction + std::numbers::pi + a;
    path.position.push_back(centre + radius * Vector3d(std::cos(angle), std::sin(angle), 0) +
                            Vector3d(0.2 * std::sin(0.37 * i), 0.2 * std::cos(0.31 * i),
                                     0.02 * radius * std::sin(2 * a)));
  }
  return path;
}

Path city_path(int n, Random& random) {
  Path path;
  constexpr double kBlock = 60;
  const int size = std::max(3, static_cast<int>(std::sqrt(n * kStep / (kBlock * 6))) + 1);
  int x = size / 2, y = size / 2, dx = 1, dy = 0;
  double along = 0;
  for (int i = 0; i < n; ++i) {
    const double px = x * kBlock + dx * along, py = y * kBlock + dy * along;
    path.position.emplace_back(px, py, 0.5 * std::sin(0.01 * px) + 0.4 * std::cos(0.013 * py));
    path.heading.push_back(std::atan2(dy, dx));
    along += kStep;
    if (along < kBlock) continue;
    along -= kBlock;
    x += dx;
    y += dy;
    for (int attempt = 0; attempt < 50; ++attempt) {
      const double u = random.uniform();
      int next_x = dx, next_y = dy;
      if (u < 0.25) {
        next_x = -dy;
        next_y = dx;
      } else if (u < 0.5) {
        next_x = dy;
        next_y = -dx;
      }
      if (x + next_x < 0 || x + next_x >= size || y + next_y < 0 || y + next_y >= size) continue;
      dx = next_x;
      dy = next_y;
      break;
    }
  }
  return path;
}

Path make_path(const PoseGraphWorldOptions& options, Random& random) {
  const int n = options.poses;
  Path path = options.shape == PoseGraphShape::kLoop     ? loop_path(n)
              : options.shape == PoseGraphShape::kLaps   ? laps_path(n)
              : options.shape == PoseGraphShape::kCampus ? campus_path(n)
                                                         : city_path(n, random);
  for (int i = 0; path.heading.size() < path.position.size(); ++i) {
    const int a = i + 1 < n ? i : i - 1;
    const Vector3d d = path.position[a + 1] - path.position[a];
    path.heading.push_back(std::atan2(d.y(), d.x()));
  }
  return path;
}

/// Earlier keyframes seen from the same place in about the same direction.
std::vector<std::pair<int, int>> find_revisits(const Path& path) {
  constexpr double kRadius = 2.0;
  constexpr int kPerKeyframe = 3;
  const int n = static_cast<int>(path.position.size());
  const auto cell_of = [](double v) { return static_cast<std::int64_t>(std::floor(v / kRadius)); };
  const auto key = [](std::int64_t x, std::int64_t y) { return (x << 32) ^ (y & 0xffffffff); };
  std::unordered_map<std::int64_t, std::vector<int>> cells;
  std::vector<std::pair<int, int>> revisits;
  std::vector<std::pair<double, int>> candidates;
  for (int i = 0; i < n; ++i) {
    const std::int64_t cx = cell_of(path.position[i].x()), cy = cell_of(path.position[i].y());
    candidates.clear();
    for (std::int64_t dx = -1; dx <= 1; ++dx) {
      for (std::int64_t dy = -1; dy <= 1; ++dy) {
        const auto cell = cells.find(key(cx + dx, cy + dy));
        if (cell == cells.end()) continue;
        for (int j : cell->second) {
          if (i - j < 60 && i - j < n / 8) continue;
          const double distance = (path.position[i] - path.position[j]).norm();
          if (std::cos(path.heading[i] - path.heading[j]) > 0.7 && distance < kRadius)
            candidates.emplace_back(distance, j);
        }
      }
    }
    std::sort(candidates.begin(), candidates.end());
    for (int k = 0; k < std::min<int>(kPerKeyframe, static_cast<int>(candidates.size())); ++k)
      revisits.emplace_back(i, candidates[k].second);
    cells[key(cx, cy)].push_back(i);
  }
  return revisits;
}

std::vector<Sim3> true_poses(const Path& path) {
  std::vector<Sim3> truth;
  for (std::size_t i = 0; i < path.position.size(); ++i) {
    const Eigen::Quaterniond q =
        Eigen::AngleAxisd(path.heading[i], Vector3d::UnitZ()) *
        Eigen::AngleAxisd(0.05 * std::sin(0.3 * static_cast<double>(i)), Vector3d::UnitX());
    truth.emplace_back(q, path.position[i], 1.0);
  }
  return truth;
}

/// Odometry: true motion disturbed step by step. With an inertial sensor (4 DoF) only yaw and position drift.
std::vector<Sim3> drifted_poses(const std::vector<Sim3>& truth, int dof, Random& random) {
  const int n = static_cast<int>(truth.size());
  const double slower = std::sqrt(1000.0 / std::max(100, n));
  const double yaw_noise = (dof == 4 ? 0.0006 : 0.0012) * slower, yaw_bias = 0.15 / n;
  const double scale_noise = dof == 7 ? 0.0006 * slower : 0, scale_bias = dof == 7 ? std::log(1.25) / n : 0;
  std::vector<Sim3> estimate{truth[0]};
  for (int i = 1; i < n; ++i) {
    const Sim3 motion = truth[i - 1].inverse() * truth[i];
    const double yaw = yaw_bias + yaw_noise * random.normal();
    const Vector3d tilt = dof == 4 ? Vector3d::Zero() : normal3(random, 0.15 * yaw_noise);
    const Vector3d shift = normal3(random, 0.004 * kStep);
    const double scale = std::exp(scale_bias + scale_noise * random.normal());
    // The error turns the rest of the way about the present position.
    const Sim3& last = estimate.back();
    const Eigen::Quaterniond turn = so3::exp(Vector3d(tilt.x(), tilt.y(), yaw));
    const Sim3 turned(turn * last.rotation, last.translation, last.scale * scale);
    estimate.push_back(turned * Sim3(motion.rotation, motion.translation + shift, 1));
  }
  // A SLAM system stores rigid poses; the drift of scale shows in the distances only.
  for (Sim3& pose : estimate) pose.scale = 1;
  return estimate;
}

/// Loops before the last quarter of the way have been closed already: there the estimate is good up to noise.
void anchor_first_part(const std::vector<Sim3>& truth, int dof, int cut, std::vector<Sim3>& estimate, Random& random) {
  const std::vector<Sim3> drifted = estimate;
  for (int i = 0; i < static_cast<int>(truth.size()); ++i) {
    if (i < cut) {
      const Vector3d tilt = dof == 4 ? Vector3d::Zero() : normal3(random, 0.002);
      estimate[i] = truth[i] * Sim3(so3::exp(tilt), normal3(random, 0.02), 1);
    } else {
      estimate[i] = estimate[i - 1] * (drifted[i - 1].inverse() * drifted[i]);
    }
  }
}

int loop_partner(const PoseGraphWorldOptions& options, const Path& path,
                 const std::vector<std::pair<int, int>>& revisits) {
  const int n = options.poses, current = n - 1;
  if (options.shape != PoseGraphShape::kLoop)
    for (auto it = revisits.rbegin(); it != revisits.rend() && it->first == current; ++it) return it->second;
  int best = 0;
  const int limit = options.shape == PoseGraphShape::kLoop ? n / 4 : n / 2;
  for (int j = 0; j < limit; ++j)
    if ((path.position[j] - path.position[current]).norm() <
        (path.position[best] - path.position[current]).norm())
      best = j;
  return best;
}

}  // namespace

void PoseGraphWorldOptions::validate() const {
  if (poses < 30) throw InvalidArgument("a pose graph world needs at least 30 poses");
  if (dof != 4 && dof != 6 && dof != 7) throw InvalidArgument("dof must be 4, 6 or 7");
}

PoseGraphShape pose_graph_shape(const std::string& name) {
  if (name == "loop") return PoseGraphShape::kLoop;
  if (name == "laps") return PoseGraphShape::kLaps;
  if (name == "city") return PoseGraphShape::kCity;
  if (name == "campus") return PoseGraphShape::kCampus;
  throw InvalidArgument("unknown shape of a pose graph: " + name + " (expected loop, laps, city or campus)");
}

PoseGraphWorld make_pose_graph_world(const PoseGraphWorldOptions& options) {
  options.validate();
  const int n = options.poses, current = n - 1, window = std::min(10, n / 8);
  Random random(options.seed);
  const Path path = make_path(options, random);
  PoseGraphWorld world;
  world.truth = true_poses(path);
  std::vector<Sim3> estimate = drifted_poses(world.truth, options.dof, random);
  std::vector<std::pair<int, int>> revisits;
  const bool one_loop = options.shape == PoseGraphShape::kLoop;
  if (!one_loop) {
    const int cut = n - n / 4;
    revisits = find_revisits(path);
    anchor_first_part(world.truth, options.dof, cut, estimate, random);
  }
  const int partner = loop_partner(options, path, revisits);
  if (!one_loop) std::erase_if(revisits, [&](const auto& r) { return r.first >= n - n / 4; });

  optimization::PoseGraphProblem& problem = world.problem;
  problem.kind = options.dof == 4   ? PoseGraphKind::kYaw
                 : options.dof == 6 ? PoseGraphKind::kSe3
                                    : PoseGraphKind::kSim3;
  problem.information = {options.dof == 4 ? optimization::published_yaw_information()
                                          : optimization::PoseGraphInformation::Identity()};
  problem.fixed.assign(n, 0);
  problem.fixed[0] = 1;

  // The loop detector relates the current keyframe to its partner and corrects the last window of keyframes.
  const Vector3d tilt = options.dof == 4 ? Vector3d::Zero() : normal3(random, 0.002);
  const double scale = options.dof != 7 ? 1.0 : one_loop ? 1 / 1.25 : 1 / 1.06;
  Sim3 found = world.truth[partner].inverse() * world.truth[current];
  found = Sim3(found.rotation * so3::exp(tilt), found.translation + normal3(random, 0.01), scale);
  std::vector<Sim3> corrected = estimate;
  for (int i = current - window + 1; i <= current; ++i)
    corrected[i] = estimate[partner] * found * (estimate[current].inverse() * estimate[i]);
  problem.poses = corrected;

  const auto add = [&](int from, int to, const std::vector<Sim3>& poses, bool loop) {
    problem.edges.push_back({from, to, poses[from].inverse() * poses[to], 0, loop});
  };
  for (int i = current - window + 1; i <= current; ++i) {
    for (int j = std::max(0, partner - 6); j <= std::min(current - window - 1, partner + 6); ++j) {
      const bool main = i == current && j == partner;
      if (i - j < window + 5 || (!main && random.uniform() > 0.35)) continue;
      if (!main && (path.position[i] - path.position[j]).norm() > 6) continue;
      add(i, j, corrected, true);
    }
  }
  for (int i = 0; i < n; ++i) {
    const int reach = 3 + static_cast<int>(random.uniform() * 7);
    for (int d = 1; d <= reach && i - d >= 0; ++d)
      if (d == 1 || random.uniform() < 1 - 0.05 * d) add(i, i - d, estimate, false);
  }
  for (const auto& [from, to] : revisits) add(from, to, estimate, false);
  return world;
}

}  // namespace fastloop::sim
