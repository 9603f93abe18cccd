#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/sensor/calibration.hpp"
#include "fastloop/sensor/frame.hpp"

namespace fastloop::io {

/// A recorded sequence. Frames are paired by time when it is opened; images are read on demand.
/// Reading different frames from several threads at once is safe.
class Dataset {
 public:
  virtual ~Dataset() = default;

  virtual std::string format() const = 0;  ///< "euroc", "tum-vi", "tum-rgbd", "kitti"
  virtual const Calibration& calibration() const = 0;
  virtual std::size_t size() const = 0;                       ///< frames, at least 1
  virtual Nanoseconds stamp_ns(std::size_t frame) const = 0;  ///< strictly increasing
  /// Images of a frame, and the IMU samples since the previous one (frame 0: since the sample
  /// before it).
  /// @throws InputError naming the file when an image cannot be read or has another size.
  virtual FrameInput load(std::size_t frame) const = 0;
  /// IMU samples needed to integrate over any interval (camera time), as FrameInput::imu holds them
  /// for neighbouring frames: for a player that skips frames. Empty without IMU.
  virtual std::vector<ImuSample> imu_between(Nanoseconds begin_ns, Nanoseconds end_ns) const = 0;
  /// Ground truth file inside the data set, if there is one.
  virtual std::optional<std::filesystem::path> ground_truth() const = 0;
  /// What was repaired or dropped while opening ("cam1: 3 images without partner dropped"), for the
  /// user.
  virtual const std::vector<std::string>& remarks() const = 0;
};

struct OpenOptions {
  std::optional<std::filesystem::path> calibration;  ///< replaces what the folder holds
};

/// Recognises the layout of a folder and opens it.
/// @throws InputError naming file, line and key
std::unique_ptr<Dataset> open_dataset(const std::filesystem::path& folder,
                                      const OpenOptions& options = {});

}  // namespace fastloop::io
