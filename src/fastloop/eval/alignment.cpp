#include "fastloop/eval/alignment.hpp"

#include <Eigen/SVD>

#include "fastloop/core/error.hpp"

namespace fastloop::eval {
namespace {

/// Second singular value of the covariance, relative to the first, below which points lie on a
/// line.
constexpr double kRelativeRankTolerance = 1e-12;

Vector3d mean(std::span<const Vector3d> points) {
  Vector3d sum = Vector3d::Zero();
  for (const Vector3d& p : points) sum += p;
  return sum / static_cast<double>(points.size());
}

}  // namespace

Alignment align(std::span<const Vector3d> from, std::span<const Vector3d> to, AlignmentKind kind) {
  if (from.size() != to.size()) throw InvalidArgument("align: unequal numbers of points");
  if (kind == AlignmentKind::kNone) return {};
  if (from.size() < 3) throw InvalidArgument("alignment needs at least three matched poses");

  const Vector3d from_mean = mean(from), to_mean = mean(to);
  const double count = static_cast<double>(from.size());
  Matrix3d covariance = Matrix3d::Zero();
  double from_variance = 0;
  for (std::size_t i = 0; i < from.size(); ++i) {
    covariance += (to[i] - to_mean) * (from[i] - from_mean).transpose() / count;
    from_variance += (from[i] - from_mean).squaredNorm() / count;
  }

  const Eigen::JacobiSVD<Matrix3d> svd(covariance, Eigen::ComputeFullU | Eigen::ComputeFullV);
  const Vector3d& singular = svd.singularValues();
  if (!(singular[1] > kRelativeRankTolerance * singular[0]))
    throw InvalidArgument("alignment is not possible: the matched positions lie on one line");
  // A reflection would fit planar or noisy points better; the last axis flips to keep a rotation.
  Vector3d sign = Vector3d::Ones();
  if (svd.matrixU().determinant() * svd.matrixV().determinant() < 0) sign.z() = -1;

  Alignment result;
  result.rotation = svd.matrixU() * sign.asDiagonal() * svd.matrixV().transpose();
  if (kind == AlignmentKind::kSim3) result.scale = singular.dot(sign) / from_variance;
  result.translation = to_mean - result.scale * (result.rotation * from_mean);
  return result;
}

}  // namespace fastloop::eval
