#pragma once

#include <cmath>
#include <cstdint>

#include "fastloop/compute/host_device.hpp"
#include "fastloop/optimization/block_kernels.hpp"

/// One edge, one vertex: residual, derivative, normal equations, step. The mathematics of
/// pose_graph_residual.cpp in plain doubles, without series that reach only so far, for one thread
/// of a device or of the host.
#if defined(__CUDA_ARCH__)
#define FASTLOOP_UNROLL _Pragma("unroll")
#elif defined(__CUDACC__)
#define FASTLOOP_UNROLL  // nvcc knows neither spelling when it compiles for the host
#else
#define FASTLOOP_UNROLL _Pragma("GCC unroll 8")
#endif

namespace fastloop::optimization::device {

using block::EdgeModel;

template <EdgeModel M>
struct Model {
  static constexpr bool kYaw = M == EdgeModel::kYaw;
  static constexpr bool kLog = M == EdgeModel::kSim3 || M == EdgeModel::kSim3FixedScale;
  static constexpr int kTangent = kYaw ? 4 : M == EdgeModel::kSim3 ? 7 : 6;
  static constexpr int kResidual = kLog ? 7 : 6;
  static constexpr int kHessian = kTangent * (kTangent + 1) / 2;
  /// What the linearisation of an edge holds: packed lower triangle of J^T W J, then J^T W e.
  static constexpr int kStride = kHessian + kTangent;
};

struct Vec3 {
  double x, y, z;
};
struct Quat {
  double x, y, z, w;
};
struct Mat3 {
  Vec3 c0, c1, c2;  ///< columns
};

FASTLOOP_HD inline Vec3 operator+(Vec3 a, Vec3 b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
FASTLOOP_HD inline Vec3 operator-(Vec3 a, Vec3 b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
FASTLOOP_HD inline Vec3 operator*(double s, Vec3 a) {
  return {s * a.x, s * a.y, s * a.z};
}
FASTLOOP_HD inline double dot(Vec3 a, Vec3 b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
FASTLOOP_HD inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
FASTLOOP_HD inline Quat conjugate(Quat q) {
  return {-q.x, -q.y, -q.z, q.w};
}
FASTLOOP_HD inline Quat operator*(Quat a, Quat b) {
  return {
      a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y, a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
      a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w, a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z};
}
FASTLOOP_HD inline Quat normalized(Quat q) {
  const double n = 1 / sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
  return {n * q.x, n * q.y, n * q.z, n * q.w};
}
FASTLOOP_HD inline Vec3 rotate(Quat q, Vec3 p) {
  const Vec3 v{q.x, q.y, q.z}, t = 2.0 * cross(v, p);
  return p + q.w * t + cross(v, t);
}
FASTLOOP_HD inline Mat3 rotation_matrix(Quat q) {
  return {rotate(q, {1, 0, 0}), rotate(q, {0, 1, 0}), rotate(q, {0, 0, 1})};
}
FASTLOOP_HD inline Vec3 operator*(const Mat3& m, Vec3 v) {
  return v.x * m.c0 + v.y * m.c1 + v.z * m.c2;
}
FASTLOOP_HD inline Mat3 operator*(const Mat3& a, const Mat3& b) {
  return {a * b.c0, a * b.c1, a * b.c2};
}
FASTLOOP_HD inline Mat3 operator+(const Mat3& a, const Mat3& b) {
  return {a.c0 + b.c0, a.c1 + b.c1, a.c2 + b.c2};
}
FASTLOOP_HD inline Mat3 operator-(const Mat3& a, const Mat3& b) {
  return {a.c0 - b.c0, a.c1 - b.c1, a.c2 - b.c2};
}
FASTLOOP_HD inline Mat3 operator*(double s, const Mat3& a) {
  return {s * a.c0, s * a.c1, s * a.c2};
}
FASTLOOP_HD inline Mat3 transposed(const Mat3& m) {
  return {{m.c0.x, m.c1.x, m.c2.x}, {m.c0.y, m.c1.y, m.c2.y}, {m.c0.z, m.c1.z, m.c2.z}};
}
FASTLOOP_HD inline Mat3 hat(Vec3 v) {
  return {{0, v.z, -v.y}, {-v.z, 0, v.x}, {v.y, -v.x, 0}};
}

struct Pose {
  Quat q;
  Vec3 t;
  double s;
};
/// Poses and measurements in memory: quaternion (x, y, z, w), translation, scale.
FASTLOOP_HD inline Pose load_pose(const double* p) {
  return {{p[0], p[1], p[2], p[3]}, {p[4], p[5], p[6]}, p[7]};
}
FASTLOOP_HD inline void store_pose(const Pose& a, double* p) {
  p[0] = a.q.x;
  p[1] = a.q.y;
  p[2] = a.q.z;
  p[3] = a.q.w;
  p[4] = a.t.x;
  p[5] = a.t.y;
  p[6] = a.t.z;
  p[7] = a.s;
}

FASTLOOP_HD inline Vec3 log_rotation(Quat q) {
  const double sign = q.w < 0 ? -1.0 : 1.0, w = sign * q.w;
  const Vec3 v = sign * Vec3{q.x, q.y, q.z};
  const double n = sqrt(dot(v, v));
  if (n < 1e-9) return ((2.0 / w) * (1.0 - n * n / (3.0 * w * w))) * v;
  return (2.0 * atan2(n, w) / n) * v;
}

FASTLOOP_HD inline Quat exp_rotation(Vec3 phi) {
  const double theta_sq = dot(phi, phi);
  double real = 1.0 - theta_sq / 8.0, scale = 0.5 - theta_sq / 48.0;
  if (theta_sq >= 1e-12) {
    const double theta = sqrt(theta_sq);
    real = cos(0.5 * theta);
    scale = sin(0.5 * theta) / theta;
  }
  return normalized({scale * phi.x, scale * phi.y, scale * phi.z, real});
}

/// Coefficient k of the inverse right Jacobian of rotations, I + hat / 2 + k hat^2.
FASTLOOP_HD inline double inverse_jacobian_coefficient(double theta_sq) {
  if (theta_sq < 0.01)
    return 1.0 / 12 + theta_sq * (1.0 / 720 + theta_sq * (1.0 / 30240 + theta_sq / 1209600));
  const double half = 0.5 * sqrt(theta_sq);
  return (1.0 - half * cos(half) / sin(half)) / theta_sq;
}

/// c I + a hat(phi) + b hat(phi)^2
struct MatrixFunction {
  double c, a, b;
};
FASTLOOP_HD inline Vec3 apply(MatrixFunction f, Vec3 phi, Vec3 p) {
  const Vec3 w = cross(phi, p);
  return f.c * p + f.a * w + f.b * cross(phi, w);
}
FASTLOOP_HD inline Mat3 apply(MatrixFunction f, Vec3 phi, const Mat3& m) {
  return {apply(f, phi, m.c0), apply(f, phi, m.c1), apply(f, phi, m.c2)};
}

/// (e^x - 1) / x of x = hat + sigma I, see geometry/sim3.hpp.
FASTLOOP_HD inline MatrixFunction exp_integral(double theta_sq, double sigma) {
  MatrixFunction f{0, 0, 0};
  if (theta_sq + sigma * sigma < 16) {
    double s = 1, u = 1, v = 0, w = 0, coefficient = 1;
    for (int k = 0; k < 60; ++k) {
      coefficient /= k + 1;
      f.c += coefficient * s;
      f.a += coefficient * v;
      f.b += coefficient * w;
      if (coefficient * (fabs(s) + fabs(u) + fabs(v) + fabs(w)) < 1e-18) break;
      w = sigma * w + v;
      const double next = sigma * u - theta_sq * v;
      v = u + sigma * v;
      u = next;
      s *= sigma;
    }
    return f;
  }
  const double theta = sqrt(theta_sq), e = exp(sigma), norm = theta_sq + sigma * sigma;
  const double re = e * cos(theta) - 1, im = e * sin(theta);
  f.c = fabs(sigma) < 1e-8 ? 1.0 + 0.5 * sigma : expm1(sigma) / sigma;
  if (theta > 1e-6) {
    f.a = (im * sigma - re * theta) / norm / theta;
    f.b = (f.c - (re * sigma + im * theta) / norm) / theta_sq;
  }
  return f;
}

FASTLOOP_HD inline MatrixFunction inverse(MatrixFunction f, double theta_sq) {
  const double p = f.c - f.b * theta_sq, d = p * p + f.a * f.a * theta_sq;
  return {1 / f.c, -f.a / d, (f.a * f.a - f.b * p) / (f.c * d)};
}

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
  double reach = size;
  for (int k = 2; k < 80; ++k) {
    q = q * w;
    m = Mat3{cross(phi, m.c0), cross(phi, m.c1), cross(phi, m.c2)} + sigma * m + q;
    v = cross(phi, v) + sigma * v;
    coefficient /= -(k + 1);
    j21 = j21 + coefficient * m;
    j23 = j23 + (-coefficient) * v;
    reach *= (sqrt(theta_sq) + fabs(sigma)) / (k + 1);
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
