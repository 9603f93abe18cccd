#pragma once

#include "fastloop/optimization/pose_graph_device_math.hpp"

/// One edge: residual, derivative, normal equations. The mathematics of pose_graph_residual.cpp for
/// one thread of a device or of the host.
namespace fastloop::optimization::device {

/// Residual and, in blocks, its derivative with respect to `to`:
///   kYaw    column 0 is [a.c0; d], the translation columns are [0; b]
///   others  rows rotation [a 0 0], translation [c b d], log scale [0 0 1]
struct Linearization {
  Vec3 rotation, translation;
  double scale;
  Mat3 a, b, c;
  Vec3 d;
};

/// Lower left block and last column of the inverse right Jacobian of Sim3, and its middle block:
/// the right Jacobian is the series of -ad, lower block triangular like ad itself.
FASTLOOP_HD inline void sim3_blocks(const Linearization& e, const Mat3& k11, Mat3& k21, Mat3& k22,
                                    Vec3& k23) {
  const Vec3 phi = e.rotation, rho = e.translation;
  const double sigma = e.scale, theta_sq = dot(phi, phi);
  const Mat3 w = hat(phi);
  Mat3 m = hat(rho), q = m;  // lower left block of ad^k, and hat(rho) hat(phi)^(k - 1)
  Mat3 j21 = -0.5 * m;
  Vec3 v = rho, j23 = 0.5 * rho;
  double coefficient = -0.5;
  const double size = sqrt(dot(rho, rho));
  const double rate = sqrt(theta_sq) + fabs(sigma);
  double reach = size;
  for (int k = 2; k < 80; ++k) {
    q = q * w;
    m = Mat3{cross(phi, m.c0), cross(phi, m.c1), cross(phi, m.c2)} + sigma * m + q;
    v = cross(phi, v) + sigma * v;
    const double over = 1.0 / (k + 1);
    coefficient *= -over;
    j21 = j21 + coefficient * m;
    j23 = j23 + (-coefficient) * v;
    reach *= rate * over;
    if (reach * k <= 1e-18 * size) break;
  }
  MatrixFunction f = inverse(exp_integral(theta_sq, -sigma), theta_sq);
  f.a = -f.a;  // a function of -hat(phi)
  k22 = apply(f, phi, Mat3{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}});
  k21 = -1.0 * (k22 * (j21 * k11));
  k23 = -1.0 * (k22 * j23);
}

template <EdgeModel M>
FASTLOOP_HD inline Linearization linearize(const Pose& from, const Pose& to, const Pose& measured) {
  Linearization e{};
  const Quat r_from_world = conjugate(from.q), z = conjugate(measured.q);
  const Vec3 difference = rotate(r_from_world, to.t - from.t);
  if constexpr (Model<M>::kYaw) {
    e.rotation = log_rotation(r_from_world * to.q * z);
    e.translation = difference - measured.t;
    e.b = transposed(rotation_matrix(from.q));
    const Vec3 phi = e.rotation, g = e.b.c2, w = cross(phi, g);
    e.a.c0 = g - 0.5 * w + inverse_jacobian_coefficient(dot(phi, phi)) * cross(phi, w);
    e.d = to.t.x * e.b.c1 - to.t.y * e.b.c0;
    return e;
  }
  const Quat q = z * (r_from_world * to.q);
  const Mat3 r_to_world = transposed(rotation_matrix(to.q));
  if constexpr (M == EdgeModel::kSe3) {
    const double sign = q.w < 0 ? -1.0 : 1.0;
    e.rotation = sign * Vec3{q.x, q.y, q.z};
    e.translation = rotate(z, difference - measured.t);
    Mat3 k11 = hat({q.x, q.y, q.z});
    k11.c0.x += q.w;
    k11.c1.y += q.w;
    k11.c2.z += q.w;
    e.a = (0.5 * sign) * (k11 * r_to_world);
    e.b = rotation_matrix(q) * r_to_world;
    e.c = -1.0 * (e.b * hat(to.t));
  }
  if constexpr (Model<M>::kLog) {
    const double over_z = 1 / measured.s;
    const Vec3 t = over_z * rotate(z, (1 / from.s) * difference - measured.t);
    e.rotation = log_rotation(q);
    e.scale = log(to.s / from.s * over_z);
    const Vec3 phi = e.rotation;
    const double theta_sq = dot(phi, phi);
    e.translation = apply(inverse(exp_integral(theta_sq, e.scale), theta_sq), phi, t);
    const MatrixFunction jacobian{1, 0.5, inverse_jacobian_coefficient(theta_sq)};
    const Mat3 k11 = apply(jacobian, phi, Mat3{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}});
    Mat3 k21, k22;
    Vec3 k23;
    sim3_blocks(e, k11, k21, k22, k23);
    e.a = k11 * r_to_world;
    e.b = (1 / to.s) * (k22 * r_to_world);
    e.c = k21 * r_to_world - e.b * hat(to.t);
    e.d = e.b * to.t + k23;
  }
  return e;
}

/// rho(squared) and its derivative; `kernel` is a RobustKernel.
FASTLOOP_HD inline double robust_cost(int kernel, double width, double squared, double& weight) {
  const double width_sq = width * width;
  weight = 1;
  if (kernel == 1 && squared > width_sq) {
    const double root = sqrt(squared);
    weight = width / root;
    return 2 * width * root - width_sq;
  }
  if (kernel == 2) {
    weight = 1 / (1 + squared / width_sq);
    return width_sq * log1p(squared / width_sq);
  }
  if (kernel == 3 && squared > width_sq) {
    const double scale = 2 * width_sq / (width_sq + squared);
    weight = scale * scale;
    return width_sq * (3 * squared - width_sq) / (width_sq + squared);
  }
  return squared;
}

/// Is entry (row, column) of the derivative zero by structure?
template <EdgeModel M>
FASTLOOP_HD constexpr bool is_zero(int row, int column) {
  if (Model<M>::kYaw) return row < 3 && column > 0;
  if (row < 3) return column >= 3;
  if (row < 6) return false;
  return M != EdgeModel::kSim3 || column < 6;
}

template <EdgeModel M>
FASTLOOP_HD inline void dense_derivative(const Linearization& e, double (*j)[7]) {
  const auto put = [](double* to, Vec3 v) {
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
  };
  if constexpr (Model<M>::kYaw) {
    put(j[0], e.a.c0);
    put(j[0] + 3, e.d);
    put(j[1] + 3, e.b.c0);
    put(j[2] + 3, e.b.c1);
    put(j[3] + 3, e.b.c2);
  } else {
    put(j[0], e.a.c0);
    put(j[1], e.a.c1);
    put(j[2], e.a.c2);
    put(j[0] + 3, e.c.c0);
    put(j[1] + 3, e.c.c1);
    put(j[2] + 3, e.c.c2);
    put(j[3] + 3, e.b.c0);
    put(j[4] + 3, e.b.c1);
    put(j[5] + 3, e.b.c2);
    if constexpr (M == EdgeModel::kSim3) {
      put(j[6] + 3, e.d);
      j[6][6] = 1;
    }
  }
}

/// Packed index of entry (r, c), r >= c, of a lower triangle.
FASTLOOP_HD constexpr int packed(int r, int c) {
  return r >= c ? r * (r + 1) / 2 + c : c * (c + 1) / 2 + r;
}

/// Linearises one edge. `information`: packed lower triangle, 28 numbers. Returns rho of the
/// squared residual; out: Model<M>::kStride numbers, `out_stride` apart.
template <EdgeModel M>
FASTLOOP_HD inline double linearize_edge(const double* from, const double* to, const double* z,
                                         const double* information, int kernel, double width,
                                         double* out, double& squared) {
  constexpr int kD = Model<M>::kTangent, kR = Model<M>::kResidual;
  const Linearization l = linearize<M>(load_pose(from), load_pose(to), load_pose(z));
  double j[kD][7];
  dense_derivative<M>(l, j);
  const double e[7] = {l.rotation.x,    l.rotation.y,    l.rotation.z, l.translation.x,
                       l.translation.y, l.translation.z, l.scale};
  double weighted[kR];
  squared = 0;
  FASTLOOP_UNROLL
  for (int r = 0; r < kR; ++r) {
    double sum = 0;
    FASTLOOP_UNROLL
    for (int k = 0; k < kR; ++k) sum += information[packed(r, k)] * e[k];
    weighted[r] = sum;
    squared += sum * e[r];
  }
  double robust;
  const double cost = robust_cost(kernel, width, squared, robust);
  FASTLOOP_UNROLL
  for (int c = 0; c < kD; ++c) {
    double gradient = 0, column[kR];
    FASTLOOP_UNROLL
    for (int r = 0; r < kR; ++r) {
      if (!is_zero<M>(r, c)) gradient += j[c][r] * weighted[r];
      double sum = 0;
      FASTLOOP_UNROLL
      for (int k = 0; k < kR; ++k)
        if (!is_zero<M>(k, c)) sum += information[packed(r, k)] * j[c][k];
      column[r] = robust * sum;
    }
    out[Model<M>::kHessian + c] = robust * gradient;
    FASTLOOP_UNROLL
    for (int o = c; o < kD; ++o) {
      double h = 0;
      FASTLOOP_UNROLL
      for (int r = 0; r < kR; ++r)
        if (!is_zero<M>(r, o)) h += j[o][r] * column[r];
      out[packed(o, c)] = h;
    }
  }
  return cost;
}

}  // namespace fastloop::optimization::device
