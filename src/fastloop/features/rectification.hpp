#pragma once

#include <memory>

#include "fastloop/sensor/calibration.hpp"
#include "fastloop/sensor/image.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop {

/// Turns images of pinhole cameras into those of ideal pinholes; a pair also gets aligned rows.
///
/// Rectified images contain no pixels from outside the recorded ones. A pair that is rectified
/// already (KITTI) and a camera without distortion pass through untouched.
class Rectification {
 public:
  /// @throws InvalidArgument when the right camera is not to the right of the left one
  static Rectification of_pair(const CameraCalibration& left, const CameraCalibration& right);
  /// One camera: its distortion is removed, its intrinsics stay.
  static Rectification of_camera(const CameraCalibration& camera);

  ~Rectification();
  Rectification(Rectification&&) noexcept;
  Rectification& operator=(Rectification&&) noexcept;

  /// The rectified pair. For one camera: baseline_m is 0, to be set by the caller.
  const StereoRig& rig() const { return rig_; }
  bool needed() const { return maps_[0] != nullptr; }

  /// @param camera  0 left, 1 right. Reentrant.
  void apply(int camera, const ImageU8& image, ImageU8& rectified) const;

 private:
  struct Maps;
  Rectification();

  StereoRig rig_;
  std::unique_ptr<Maps> maps_[2];  ///< null: images pass through
};

}  // namespace fastloop
