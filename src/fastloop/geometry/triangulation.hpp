#pragma once

#include <Eigen/Eigenvalues>
#include <cmath>
#include <optional>

#include "fastloop/geometry/se3.hpp"

namespace fastloop {

/// Cosine of the angle under which two cameras see a point: 1 = no parallax, no depth. Unit rays,
/// each in its own camera frame.
inline double parallax_cosine(const Vector3d& ray_first, const Vector3d& ray_second,
                              const Eigen::Quaterniond& R_second_first) {
  return (R_second_first * ray_first).dot(ray_second);
}

/// The point half way between two rays where they are nearest, in the frame of the first camera. It
/// lies behind a camera when the rays diverge: check its depth. Nothing when the rays are parallel.
inline std::optional<Vector3d> triangulate_midpoint(const Vector3d& ray_first,
                                                    const Vector3d& ray_second,
                                                    const SE3& T_second_first) {
  const SE3 T_first_second = T_second_first.inverse();
  const Vector3d a = ray_first;
  const Vector3d b = T_first_second.rotation * ray_second;
  const Vector3d& t = T_first_second.translation;
  const double ab = a.dot(b), aa = a.squaredNorm(), bb = b.squaredNorm();
  const double determinant = aa * bb - ab * ab;
  if (!(determinant > 1e-14 * aa * bb)) return std::nullopt;
  const double along_a = (t.dot(a) * bb - t.dot(b) * ab) / determinant;
  const double along_b = (t.dot(a) * ab - t.dot(b) * aa) / determinant;
  return Vector3d(0.5 * (along_a * a + t + along_b * b));
}

/// Linear (DLT) triangulation: the homogeneous point whose image is least far from both rays, in
/// the frame of the first camera. Nothing for a point at infinity.
inline std::optional<Vector3d> triangulate_dlt(const Vector3d& ray_first,
                                               const Vector3d& ray_second,
                                               const SE3& T_second_first) {
  // Each camera gives two equations: the point has no component across its ray.
  Eigen::Matrix4d equations;
  const auto add = [&](int row, const Vector3d& ray, const SE3& T) {
    const Vector3d u = ray.unitOrthogonal(), v = ray.normalized().cross(u);
    const Matrix3d R = T.rotation.toRotationMatrix();
    equations.row(row) << u.transpose() * R, u.dot(T.translation);
    equations.row(row + 1) << v.transpose() * R, v.dot(T.translation);
  };
  // Lengths in units of the baseline keep the system well scaled.
  const double baseline = T_second_first.translation.norm();
  if (!(baseline > 0)) return std::nullopt;
  add(0, ray_first, SE3());
  add(2, ray_second, SE3(T_second_first.rotation, T_second_first.translation / baseline));
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix4d> solver(equations.transpose() * equations);
  const Eigen::Vector4d p = solver.eigenvectors().col(0);
  if (std::abs(p[3]) < 1e-7) return std::nullopt;
  return Vector3d(p.head<3>() * (baseline / p[3]));
}

}  // namespace fastloop
