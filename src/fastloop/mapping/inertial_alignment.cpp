#include "fastloop/mapping/inertial_alignment.hpp"

#include <algorithm>

#include "fastloop/mapping/local_adjustment.hpp"
#include "fastloop/optimization/inertial_init.hpp"

namespace fastloop::mapping {
namespace {

constexpr int kFirstAdjustmentIterations = 12;
constexpr double kMaxGyroBias = 0.5;   ///< rad / s; more is a failed estimate, not a sensor
constexpr double kMaxAccelBias = 2.5;  ///< m / s^2

/// Live keyframes that are connected by IMU measurements up to the newest one, oldest first.
std::vector<KeyframeId> inertial_chain(const map::Map& map, MapId id) {
  std::vector<KeyframeId> chain;
  KeyframeId k = map.map_info(id).last_keyframe;
  while (k.valid()) {
    chain.push_back(k);
    if (!map.keyframe(k).imu_from_previous) break;
    k = map.keyframe(k).previous;
  }
  std::reverse(chain.begin(), chain.end());
  return chain;
}

optimization::InertialInitProblem make_problem(const map::Map& map,
                                               const std::vector<KeyframeId>& chain, int stage) {
  optimization::InertialInitProblem problem;
  const bool first = stage == 0;
  problem.guess_gravity = first;
  problem.gyro_prior_information = first ? 1e2 : 1.0;
  problem.accel_prior_information = first ? 1e2 : stage == 1 ? 1e1 : 1.0;
  problem.bias = map.keyframe(chain.back()).state.bias;
  for (const KeyframeId k : chain) {
    problem.T_world_body.push_back(map.keyframe(k).state.T_world_body);
    if (!first) problem.v_world.push_back(map.keyframe(k).state.v_world);
    if (k != chain.front()) problem.between.push_back(map.keyframe(k).imu_from_previous);
  }
  return problem;
}

void apply(map::Map& map, MapId id, const std::vector<KeyframeId>& chain,
           const optimization::InertialInitResult& r) {
  for (std::size_t i = 0; i < chain.size(); ++i) {
    NavState state = map.keyframe(chain[i]).state;
    state.v_world = r.v_world[i];
    state.bias = r.bias;
    map.set_state(chain[i], state);
    if (i > 0)
      map.set_imu(chain[i], std::make_shared<PreintegratedImu>(
                                map.keyframe(chain[i]).imu_from_previous->rebased(r.bias)));
  }
  map.transform_map(id, SE3(Matrix3d(r.R_world_gravity.transpose()), Vector3d::Zero()));
}

}  // namespace

ImuStep align_to_imu(map::Map& map, MapId id, const MappingOptions& options,
                     const std::atomic<bool>* cancel) {
  ImuStep step;
  const map::MapInfo& info = map.map_info(id);
  const int stage = info.imu_initialized ? 1 + info.imu_refinements : 0;
  if (stage > 2) return step;
  const std::vector<KeyframeId> chain = inertial_chain(map, id);
  if (static_cast<int>(chain.size()) < options.imu_min_keyframes) return step;
  step.seconds = to_seconds(map.keyframe(chain.back()).data->stamp_ns -
                            map.keyframe(chain.front()).data->stamp_ns);
  const double needed = stage == 0   ? options.imu_min_seconds
                        : stage == 1 ? options.imu_refine_first_s
                                     : options.imu_refine_second_s;
  if (step.seconds < needed) return step;

  const auto result = optimization::initialize_inertial(make_problem(map, chain, stage));
  step.gravity_stddev_rad = result.gravity_stddev_rad;
  if (!result.success || result.bias.gyro.norm() > kMaxGyroBias ||
      result.bias.accel.norm() > kMaxAccelBias) {
    step.kind = ImuStep::Kind::kFailed;
    step.reason = result.success ? "the estimated bias is implausible" : result.reason;
    // A failed refinement is not tried again: the state in use is consistent.
    if (stage > 0) ++map.mutable_info(id).imu_refinements;
    return step;
  }
  apply(map, id, chain, result);
  if (stage == 0)
    map.mutable_info(id).imu_initialized = true;
  else
    ++map.mutable_info(id).imu_refinements;
  adjust_whole_map(map, id, true, kFirstAdjustmentIterations, options, cancel);
  step.kind = stage == 0 ? ImuStep::Kind::kInitialised : ImuStep::Kind::kRefined;
  step.reason =
      std::to_string(chain.size()) + " keyframes over " + std::to_string(step.seconds) + " s";
  return step;
}

}  // namespace fastloop::mapping
