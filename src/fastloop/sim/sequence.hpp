#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/io/dataset.hpp"
#include "fastloop/sim/imu_simulator.hpp"
#include "fastloop/sim/renderer.hpp"
#include "fastloop/sim/rig.hpp"

namespace fastloop::sim {

struct SequenceOptions {
  WorldKind world = WorldKind::kRoom;
  CameraKind camera = CameraKind::kPinhole;
  double seconds = 0;      ///< 0 = usual length of the world, or the whole recorded motion
  std::uint64_t seed = 1;
  bool noise = true;       ///< of images, depth and IMU (without it also no IMU bias)
  std::optional<std::filesystem::path> motion;        ///< recorded trajectory to fly (EuRoC csv or TUM)
  std::optional<std::filesystem::path> recorded_imu;  ///< with `motion`: used instead of a synthetic IMU
  std::optional<Calibration> rig;  ///< replaces make_rig(camera), for example with small images
  /// Throws InvalidArgument naming the value that cannot be used.
  void validate() const;
};

/// A simulated recording in memory: frames are rendered when asked for, nothing is written.
///
/// Everything follows from the options: the same options give the same bytes, whatever the number of
/// threads. All const functions are thread-safe; rendering uses the calling oneTBB arena.
class SimulatedSequence : public io::Dataset {
 public:
  /// @throws InvalidArgument on bad options, InputError when a recorded file cannot be used
  explicit SimulatedSequence(const SequenceOptions& options);

  std::string format() const override { return "simulated"; }
  const Calibration& calibration() const override { return calibration_; }
  std::size_t size() const override { return stamps_ns_.size(); }
  Nanoseconds stamp_ns(std::size_t frame) const override { return stamps_ns_.at(frame); }
  FrameInput load(std::size_t frame) const override { return this->frame(frame); }
  std::vector<ImuSample> imu_between(Nanoseconds begin_ns, Nanoseconds end_ns) const override;
  std::optional<std::filesystem::path> ground_truth() const override { return std::nullopt; }
  const std::vector<std::string>& remarks() const override { return remarks_; }

  FrameInput frame(std::size_t index) const;
  /// One image of a frame, camera 0 or 1.
  ImageU8 image(std::size_t index, int camera, ImageF32* depth = nullptr) const;
  /// Exact state at any time of the sequence; biases are those of the nearest IMU sample.
  NavState ground_truth(Nanoseconds stamp_ns) const;

  const World& world() const { return renderer_->world(); }
  const Trajectory& trajectory() const { return *trajectory_; }
  const std::vector<ImuSample>& imu() const { return imu_.samples; }
  const SequenceOptions& options() const { return options_; }

 private:
  void prepare_motion();
  void prepare_stamps();
  void prepare_imu();
  double trajectory_time(Nanoseconds stamp_ns) const { return to_seconds(stamp_ns - zero_ns_); }

  SequenceOptions options_;
  Calibration calibration_;
  std::optional<Trajectory> trajectory_;
  Nanoseconds zero_ns_ = 0;    ///< stamp of trajectory time 0
  std::vector<Nanoseconds> stamps_ns_;
  SimulatedImu imu_;           ///< biases are empty when the IMU is a recorded one
  std::unique_ptr<Renderer> renderer_;
  std::vector<RayTable> tables_;
  std::vector<std::string> remarks_;
};

}  // namespace fastloop::sim
