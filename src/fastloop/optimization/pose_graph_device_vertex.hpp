#pragma once

#include "fastloop/optimization/pose_graph_device_math.hpp"

/// One vertex: its step and how a step is measured, for one thread of a device or of the host.
namespace fastloop::optimization::device {

/// A vertex moved by a step in the world frame, see move_vertex.
template <EdgeModel M>
FASTLOOP_HD inline void move_pose(const double* p, const double* d, double* out) {
  Pose x = load_pose(p);
  if constexpr (Model<M>::kYaw) {
    x.q = normalized(exp_rotation({0, 0, d[0]}) * x.q);
    x.t = {x.t.x - d[0] * x.t.y + d[1], x.t.y + d[0] * x.t.x + d[2], x.t.z + d[3]};
  } else {
    const Vec3 phi{d[0], d[1], d[2]}, rho{d[3], d[4], d[5]};
    const Quat q = exp_rotation(phi);
    if constexpr (M == EdgeModel::kSe3) {
      x.t = x.t + cross(phi, x.t) + rho;
    } else {
      double sigma = 0;
      if constexpr (M == EdgeModel::kSim3) sigma = d[6];
      const Vec3 shift = apply(exp_integral(dot(phi, phi), sigma), phi, rho);
      const double s = exp(sigma);
      x.t = s * rotate(q, x.t) + shift;
      x.s *= s;
    }
    x.q = normalized(q * x.q);
  }
  store_pose(x, out);
}

/// Entry (r, c) of the damping metric of a vertex: squared length of a step seen in its own frame.
template <EdgeModel M>
FASTLOOP_HD inline double damping_entry(const double* pose, int r, int c) {
  const double t[3] = {pose[4], pose[5], pose[6]}, inverse = 1 / pose[7];
  // Column k of the map from the step to [rotation, translation, log scale] in the vertex's frame.
  const auto column = [&](int k, double* v) {
    for (int i = 0; i < 7; ++i) v[i] = 0;
    if (Model<M>::kYaw) {
      if (k == 0) {
        v[2] = 1;
        v[3] = -t[1] * inverse;
        v[4] = t[0] * inverse;
      } else {
        v[2 + k] = inverse;
      }
      return;
    }
    if (k < 3) {
      v[k] = 1;
      // -hat(t) e_k = e_k x t
      v[3 + (k + 1) % 3] = -t[(k + 2) % 3] * inverse;
      v[3 + (k + 2) % 3] = t[(k + 1) % 3] * inverse;
    } else if (k < 6) {
      v[k] = inverse;
    } else {
      for (int i = 0; i < 3; ++i) v[3 + i] = t[i] * inverse;
      v[6] = 1;
    }
  };
  double a[7], b[7], sum = 0;
  column(r, a);
  column(c, b);
  for (int i = 0; i < 7; ++i) sum += a[i] * b[i];
  return sum;
}

}  // namespace fastloop::optimization::device
