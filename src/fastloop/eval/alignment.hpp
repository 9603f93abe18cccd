#pragma once

#include <span>

#include "fastloop/geometry/se3.hpp"

namespace fastloop::eval {

enum class AlignmentKind { kNone, kSe3, kSim3 };

/// Similarity that carries the world of an estimate onto the world of the reference:
/// p_reference = scale * R * p_estimate + t.
struct Alignment {
  double scale = 1;
  Matrix3d rotation = Matrix3d::Identity();
  Vector3d translation = Vector3d::Zero();

  Vector3d operator*(const Vector3d& p) const { return scale * (rotation * p) + translation; }
  /// The pose in the reference's world; the scale acts on its position only.
  SE3 operator*(const SE3& pose) const {
    return {Matrix3d(rotation * pose.rotation.toRotationMatrix()), *this * pose.translation};
  }
};

/// Least-squares alignment of points (Umeyama, "Least-squares estimation of transformation
/// parameters between two point patterns", PAMI 1991): minimises sum |to - alignment * from|^2.
///
/// @param from, to  metres, [n] each
/// @throws InvalidArgument on unequal sizes, fewer than three points, or points on one line (the
///         rotation about it would be arbitrary)
Alignment align(std::span<const Vector3d> from, std::span<const Vector3d> to, AlignmentKind kind);

}  // namespace fastloop::eval
