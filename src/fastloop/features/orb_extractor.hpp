#pragma once

#include <memory>

#include "fastloop/features/feature_set.hpp"
#include "fastloop/sensor/image.hpp"

namespace fastloop {

struct OrbOptions {
  int num_features = 1200;
  int levels = 8;
  float scale_factor = 1.2f;
  int fast_threshold = 20;     ///< grey levels
  int fast_min_threshold = 7;  ///< used in cells where the first threshold finds nothing
  void validate() const;       ///< throws InvalidArgument naming the field
};

/// Image pyramid of a frame, kept for sub-pixel stereo refinement.
struct ImagePyramid {
  std::vector<ImageU8> levels;
};

/// Keypoints and descriptors of one image, before stereo matching. Pixels at level 0.
struct OrbFeatures {
  std::vector<float> x, y, angle_rad, response;
  std::vector<std::uint8_t> octave;
  std::vector<Descriptor> descriptors;
  std::size_t size() const { return x.size(); }
};

/// ORB features (Rublee et al., ICCV 2011) spread evenly over the image and over the levels.
///
/// Deterministic. Not thread-safe: one extractor per thread (it keeps its buffers; no allocation of
/// images in the steady state).
class OrbExtractor {
 public:
  explicit OrbExtractor(const OrbOptions& options = {});
  ~OrbExtractor();
  OrbExtractor(OrbExtractor&&) noexcept;

  /// @throws InvalidArgument on an empty image. An image without texture gives no features.
  OrbFeatures extract(const ImageU8& image);
  /// Pyramid of the last `extract`.
  const ImagePyramid& pyramid() const;
  const OrbOptions& options() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace fastloop
