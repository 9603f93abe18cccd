#pragma once

#include <memory>

#include "fastloop/core/timing.hpp"
#include "fastloop/features/orb_extractor.hpp"
#include "fastloop/sensor/calibration.hpp"
#include "fastloop/sensor/frame.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

namespace fastloop {

/// From the images of a frame to its features with stereo or depth.
///
/// Two pinhole cameras: both images are rectified, matched along rows with sub-pixel refinement.
/// A fisheye pair: not rectified; matched by descriptor with epipolar check, triangulated.
/// RGB-D: depth gives the virtual right coordinate.
/// Left and right run in parallel on oneTBB. The result does not depend on the number of threads.
class FrameBuilder {
 public:
  /// @throws InvalidArgument when the calibration is neither a stereo pair nor an RGB-D camera, or
  ///         mixes camera models.
  FrameBuilder(const Calibration& calibration, const OrbOptions& options);
  ~FrameBuilder();

  /// The cameras as seen by everything downstream (rectified where images are rectified; then
  /// T_body_left is that of the rectified left camera).
  const StereoRig& rig() const;

  /// @param times  may be null; stages "rectify", "orb", "stereo"
  /// @throws InvalidArgument when the image sizes differ from the calibration.
  FeatureSet build(const FrameInput& input, StageTimes* times = nullptr);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace fastloop
