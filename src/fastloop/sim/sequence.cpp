#include "fastloop/sim/sequence.hpp"

#include <algorithm>
#include <cmath>

#include "fastloop/core/error.hpp"
#include "fastloop/io/imu_recording.hpp"
#include "fastloop/io/trajectory.hpp"

namespace fastloop::sim {
namespace {

constexpr Nanoseconds kStartNs = 1'600'000'000'000'000'000;  ///< stamp of the first synthetic frame
constexpr double kRecordedKnotSeconds = 0.05;
constexpr double kShortestSeconds = 0.1, kLongestSeconds = 7200;

/// Brightness of a frame: the slow drift of an automatic exposure, the two cameras a little apart.
float exposure_gain(double t_s, int camera, std::uint64_t seed) {
  const double phase = 2 * M_PI * static_cast<double>(mix64(seed ^ 0xE0) >> 11) * 0x1.0p-53;
  const double drift = 0.10 * std::sin(2 * M_PI * t_s / 17 + phase) + 0.04 * std::sin(2 * M_PI * t_s / 7.3);
  return static_cast<float>((1.25 + drift) * (camera == 0 ? 1.0 : 1.035));
}

std::uint64_t image_seed(std::uint64_t seed, std::size_t frame, int camera) {
  return mix64(mix64(seed) + 4 * static_cast<std::uint64_t>(frame) + static_cast<std::uint64_t>(camera));
}

}  // namespace

void SequenceOptions::validate() const {
  if (seconds != 0 && !(seconds >= kShortestSeconds && seconds <= kLongestSeconds))
    throw InvalidArgument("seconds must lie between 0.1 and 7200");
  if (recorded_imu && !motion)
    throw InvalidArgument("a recorded IMU needs the recorded motion it belongs to");
  if (recorded_imu && camera == CameraKind::kRgbd)
    throw InvalidArgument("the depth camera of the simulator has no IMU");
  if (rig) rig->validate();
}

SimulatedSequence::SimulatedSequence(const SequenceOptions& options) : options_(options) {
  options_.validate();
  calibration_ = options_.rig ? *options_.rig : make_rig(options_.camera);
  prepare_motion();
  prepare_stamps();
  prepare_imu();
  const std::vector<Vector3d> path = sample_path(*trajectory_);
  const std::uint64_t world_seed = mix64(options_.seed) ^ 0x770A1D;
  renderer_ = std::make_unique<Renderer>(options_.motion ? make_world_around(world_seed, path)
                                                         : make_world(options_.world, world_seed, path));
  for (const CameraCalibration& camera : calibration_.cameras) tables_.emplace_back(camera.camera);
}

void SimulatedSequence::prepare_motion() {
  if (!options_.motion) {
    if (options_.seconds == 0) options_.seconds = default_seconds(options_.world);
    trajectory_ = make_motion(options_.world, options_.seconds, options_.seed, carrier_from_body(calibration_));
    zero_ns_ = kStartNs;
    return;
  }
  const io::Trajectory recorded = io::read_trajectory(*options_.motion);
  remarks_ = recorded.remarks;
  zero_ns_ = recorded.poses.front().stamp_ns;
  std::vector<double> times_s;
  std::vector<SE3> poses;
  for (const io::StampedPose& p : recorded.poses) {
    times_s.push_back(to_seconds(p.stamp_ns - zero_ns_));
    poses.push_back(p.T_world_x);
  }
  if (times_s.back() < kShortestSeconds)
    throw InputError({options_.motion->string(), 0, ""}, "the motion is too short", "at least 0.1 s of poses");
  trajectory_ = Trajectory::fit(times_s, poses, kRecordedKnotSeconds);
  if (options_.seconds == 0 || options_.seconds > times_s.back()) options_.seconds = times_s.back();
}

void SimulatedSequence::prepare_stamps() {
  // Whole microseconds, because the layout of RGB-D sequences keeps six decimals.
  const Nanoseconds period_ns = 1000 * std::llround(1e6 / calibration_.cameras[0].rate_hz);
  const Nanoseconds first_ns = (zero_ns_ + 999) / 1000 * 1000;
  const Nanoseconds end_ns = zero_ns_ + from_seconds(options_.seconds);
  for (Nanoseconds t = first_ns; t <= end_ns; t += period_ns) stamps_ns_.push_back(t);
}

void SimulatedSequence::prepare_imu() {
  if (!calibration_.imu) return;
  if (options_.recorded_imu) {
    io::ImuRecording recording = io::read_imu_recording(*options_.recorded_imu, 0);
    remarks_.insert(remarks_.end(), recording.remarks.begin(), recording.remarks.end());
    imu_.samples = std::move(recording.samples);
    std::erase_if(stamps_ns_, [&](Nanoseconds t) {
      return imu_.samples.empty() || t < imu_.samples.front().stamp_ns || t > imu_.samples.back().stamp_ns;
    });
    if (stamps_ns_.empty())
      throw InputError({options_.recorded_imu->string(), 0, ""},
                       "no IMU sample lies within the time of the motion", "the IMU of the same recording");
    return;
  }
  ImuSimulationOptions imu_options;
  imu_options.seed = mix64(options_.seed) ^ 0x1A0;
  imu_options.noise = options_.noise;
  if (options_.noise) imu_options.initial_bias = draw_initial_bias(options_.seed);
  imu_ = simulate_imu(*trajectory_, *calibration_.imu, zero_ns_, stamps_ns_.front(),
                      stamps_ns_.back(), imu_options);
}

std::vector<ImuSample> SimulatedSequence::imu_between(Nanoseconds begin_ns, Nanoseconds end_ns) const {
  const auto samples = io::imu_covering(imu_.samples, begin_ns, end_ns);
  return {samples.begin(), samples.end()};
}

ImageU8 SimulatedSequence::image(std::size_t index, int camera, ImageF32* depth) const {
  const Nanoseconds stamp = stamps_ns_.at(index);
  const SE3 T_world_camera = trajectory_->pose(trajectory_time(stamp)) * calibration_.cameras.at(camera).T_body_camera;
  Exposure exposure;
  exposure.gain = exposure_gain(trajectory_time(stamp), camera, options_.seed);
  exposure.noise_seed = image_seed(options_.seed, index, camera);
  if (!options_.noise) exposure.noise_offset = exposure.noise_slope = 0;
  DepthNoise depth_noise;
  depth_noise.enabled = options_.noise;
  depth_noise.seed = image_seed(options_.seed, index, 3);
  if (calibration_.depth) {
    depth_noise.units_per_metre = static_cast<float>(calibration_.depth->units_per_metre);
    depth_noise.max_depth_m = static_cast<float>(calibration_.depth->max_depth_m);
  }
  return renderer_->render(tables_.at(camera), T_world_camera, exposure, depth, depth_noise);
}

FrameInput SimulatedSequence::frame(std::size_t index) const {
  FrameInput input;
  input.stamp_ns = stamp_ns(index);
  input.left = image(index, 0, calibration_.depth ? &input.depth : nullptr);
  if (calibration_.cameras.size() > 1) input.right = image(index, 1);
  input.imu = imu_between(index > 0 ? stamps_ns_[index - 1] : input.stamp_ns, input.stamp_ns);
  return input;
}

NavState SimulatedSequence::ground_truth(Nanoseconds stamp_ns) const {
  const double t = trajectory_time(stamp_ns);
  NavState state;
  state.T_world_body = trajectory_->pose(t);
  state.v_world = trajectory_->velocity(t);
  if (!imu_.biases.empty()) {
    const double k = to_seconds(stamp_ns - imu_.samples.front().stamp_ns) * calibration_.imu->rate_hz;
    const double last = static_cast<double>(imu_.biases.size() - 1);
    state.bias = imu_.biases[static_cast<std::size_t>(std::clamp(std::round(k), 0.0, last))];
  }
  return state;
}

}  // namespace fastloop::sim
