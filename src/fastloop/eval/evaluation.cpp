#include "fastloop/eval/evaluation.hpp"

#include "fastloop/core/error.hpp"
#include "fastloop/eval/association.hpp"

namespace fastloop::eval {
namespace {

std::vector<Vector3d> positions(std::span<const SE3> poses) {
  std::vector<Vector3d> result;
  result.reserve(poses.size());
  for (const SE3& pose : poses) result.push_back(pose.translation);
  return result;
}

double end_drift_m(const Evaluation& e) {
  const IndexPair whole{0, e.reference.size() - 1};
  return relative_errors(e.reference, e.estimate, {&whole, 1}).translation_m[0];
}

RelativePoseError evaluate_relative(const Evaluation& e, double seconds) {
  const auto errors = [&](RpePairs which) {
    const auto pairs = pairs_in_time(e.stamps_ns, from_seconds(seconds), which);
    if (pairs.empty())
      throw InvalidArgument("no two matched poses are " + std::to_string(seconds) + " s apart");
    return relative_errors(e.reference, e.estimate, pairs);
  };
  const RelativeErrors all = errors(RpePairs::kAll);
  const RelativeErrors chain = errors(RpePairs::kConsecutive);
  return {seconds, summarize_errors(all.translation_m), summarize_errors(all.rotation_deg),
          summarize_errors(chain.translation_m), summarize_errors(chain.rotation_deg)};
}

}  // namespace

Evaluation evaluate(std::span<const io::StampedPose> reference,
                    std::span<const io::StampedPose> estimate, const EvaluationOptions& options) {
  Evaluation e;
  e.reference_poses = reference.size();
  e.estimate_poses = estimate.size();
  e.coverage = time_coverage(reference, estimate);
  for (const Match& match : associate(reference, estimate)) {
    e.stamps_ns.push_back(estimate[match.estimate].stamp_ns);
    e.reference.push_back(reference[match.reference].T_world_x);
    e.estimate.push_back(estimate[match.estimate].T_world_x);
  }
  if (e.reference.empty())
    throw InvalidArgument("no pose of the estimate lies within 0.01 s of one of the ground truth");

  e.alignment = align(positions(e.estimate), positions(e.reference), options.alignment);
  for (SE3& pose : e.estimate) pose = e.alignment * pose;
  e.errors_m = position_errors(e.reference, e.estimate);
  e.ate_m = summarize_errors(e.errors_m);
  e.path_length_m = path_length(e.reference);
  if (e.path_length_m > 0) {
    e.ate_percent = 100 * e.ate_m.rmse / e.path_length_m;
    e.end_drift_percent = 100 * end_drift_m(e) / e.path_length_m;
  }
  if (options.rpe_seconds) e.rpe = evaluate_relative(e, *options.rpe_seconds);
  return e;
}

}  // namespace fastloop::eval
