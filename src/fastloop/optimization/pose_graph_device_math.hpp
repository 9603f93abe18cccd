#pragma once

#include <cmath>
#include <cstdint>

#include "fastloop/compute/host_device.hpp"
#include "fastloop/optimization/block_kernels.hpp"

/// Vectors, rotations and the functions of their logarithms in plain doubles, without series that
/// reach only so far, for one thread of a device or of the host.
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
      coefficient *= 1.0 / (k + 1);
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

}  // namespace fastloop::optimization::device
