#pragma once

#include <algorithm>
#include <cstdint>
#include <random>
#include <vector>

#include "fastloop/optimization/pose_graph.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

/// Graphs for the tests of the solvers.
namespace fastloop::optimization::testing {

class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}
  double normal() { return normal_(engine_); }
  double uniform() { return uniform_(engine_); }
  int integer(int n) { return std::min(n - 1, static_cast<int>(uniform() * n)); }
  Vector7d tangent(double rotation, double translation, double log_scale) {
    Vector7d d;
    for (int i = 0; i < 7; ++i)
      d[i] = normal() * (i < 3 ? rotation : i < 6 ? translation : log_scale);
    return d;
  }

 private:
  std::mt19937_64 engine_;
  std::normal_distribution<double> normal_{0, 1};
  std::uniform_real_distribution<double> uniform_{0, 1};
};

/// A chain with some longer edges: measurements are true ones with noise, poses start off by more.
struct RandomGraphOptions {
  PoseGraphKind kind = PoseGraphKind::kSe3;
  int poses = 20;
  double extra_edges = 1.0;    ///< per pose
  double noise = 0.02;         ///< of measurements
  double displacement = 0.05;  ///< of the start
  bool full_information = true;
};

inline PoseGraphInformation random_information(Random& random, bool full) {
  Matrix7d m = Matrix7d::Zero();
  for (int i = 0; i < 7; ++i) m(i, i) = 0.5 + 3 * random.uniform();
  if (full)
    for (int i = 0; i < 7; ++i)
      for (int k = 0; k < i; ++k) m(i, k) = 0.3 * random.normal();
  return m * m.transpose();
}

inline Sim3 random_pose(Random& random, PoseGraphKind kind, double spread) {
  Vector7d d = random.tangent(0.6, 0, 0.2);
  Sim3 pose = Sim3::exp(d);
  pose.translation = spread * Vector3d(random.normal(), random.normal(), random.normal());
  if (kind != PoseGraphKind::kSim3) pose.scale = 1;
  return pose;
}

/// Disturbs a pose in the ways its kind allows.
inline Sim3 disturbed(Random& random, PoseGraphKind kind, const Sim3& pose, double size) {
  Vector7d d = random.tangent(size, size, 0.5 * size);
  if (kind == PoseGraphKind::kYaw)
    d = Vector7d(Vector7d::Unit(0) * d[0] +
                 d.cwiseProduct((Vector7d() << 0, 1, 1, 1, 0, 0, 0).finished()));
  if (kind == PoseGraphKind::kSe3) d[6] = 0;
  return move_vertex(kind, pose, d);
}

inline PoseGraphProblem random_graph(Random& random, const RandomGraphOptions& options) {
  PoseGraphProblem p;
  p.kind = options.kind;
  std::vector<Sim3> truth;
  for (int i = 0; i < options.poses; ++i) {
    truth.push_back(random_pose(random, options.kind, 2.0));
    p.poses.push_back(disturbed(random, options.kind, truth.back(), options.displacement));
  }
  p.information.clear();
  for (int k = 0; k < 5; ++k)
    p.information.push_back(random_information(random, options.full_information));
  const auto add = [&](int from, int to) {
    Vector7d noise = random.tangent(options.noise, options.noise, options.noise);
    if (options.kind != PoseGraphKind::kSim3) noise[6] = 0;
    p.edges.push_back(
        {from, to, truth[from].inverse() * truth[to] * Sim3::exp(noise), random.integer(5), false});
  };
  for (int i = 1; i < options.poses; ++i) random.uniform() < 0.5 ? add(i - 1, i) : add(i, i - 1);
  for (int k = 0; k < static_cast<int>(options.extra_edges * options.poses); ++k) {
    const int a = random.integer(options.poses), b = random.integer(options.poses);
    if (a == b) continue;
    add(a, b);
    p.edges.back().switchable = true;
  }
  p.fixed.assign(options.poses, 0);
  p.fixed[random.integer(options.poses)] = 1;
  return p;
}

inline double largest_difference(const std::vector<Sim3>& a, const std::vector<Sim3>& b) {
  double largest = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    largest = std::max(largest, (a[i].translation - b[i].translation).norm());
    largest = std::max(largest, so3::log(a[i].rotation.conjugate() * b[i].rotation).norm());
    largest = std::max(largest, std::abs(a[i].scale - b[i].scale));
  }
  return largest;
}

inline PoseGraphProblem graph_of(PoseGraphKind kind, int poses, std::uint64_t seed,
                                 double displacement = 0.05) {
  Random random(seed);
  RandomGraphOptions options;
  options.kind = kind;
  options.poses = poses;
  options.displacement = displacement;
  return random_graph(random, options);
}

inline bool same_bytes(const std::vector<Sim3>& a, const std::vector<Sim3>& b) {
  if (a.size() != b.size()) return false;
  for (std::size_t i = 0; i < a.size(); ++i)
    if (a[i].rotation.coeffs() != b[i].rotation.coeffs() || a[i].translation != b[i].translation ||
        a[i].scale != b[i].scale)
      return false;
  return true;
}

}  // namespace fastloop::optimization::testing
