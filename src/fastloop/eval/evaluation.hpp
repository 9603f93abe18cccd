#pragma once

#include <optional>
#include <span>
#include <vector>

#include "fastloop/eval/alignment.hpp"
#include "fastloop/eval/metrics.hpp"
#include "fastloop/io/trajectory.hpp"

namespace fastloop::eval {

struct EvaluationOptions {
  AlignmentKind alignment = AlignmentKind::kSe3;
  std::optional<double> rpe_seconds;
};

/// Relative pose error over a fixed time.
struct RelativePoseError {
  double seconds = 0;
  Statistics translation_m, rotation_deg;                          ///< all pairs
  Statistics consecutive_translation_m, consecutive_rotation_deg;  ///< evo's default pairs
};

/// An estimate compared with the ground truth; the vectors hold the matched poses, ordered by time.
struct Evaluation {
  std::vector<Nanoseconds> stamps_ns;  ///< of the estimate
  std::vector<SE3> reference;
  std::vector<SE3> estimate;  ///< after alignment
  std::vector<double> errors_m;

  std::size_t reference_poses = 0, estimate_poses = 0;
  double coverage = 0;  ///< see time_coverage
  Alignment alignment;
  Statistics ate_m;
  double path_length_m = 0;  ///< along the matched reference poses
  /// ATE (RMSE) as percentage of the path; 0 when the path has no length.
  double ate_percent = 0;
  /// Position error of the whole motion, from the first matched pose to the last seen from the
  /// first, as percentage of the path. Both files must follow the same body.
  double end_drift_percent = 0;
  std::optional<RelativePoseError> rpe;
};

/// @throws InvalidArgument when no poses match, alignment is not possible, or no two poses are
///         `rpe_seconds` apart
Evaluation evaluate(std::span<const io::StampedPose> reference,
                    std::span<const io::StampedPose> estimate, const EvaluationOptions& options);

}  // namespace fastloop::eval
