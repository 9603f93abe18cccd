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
  std::vector<ImageU8> levels;  ///< [0] is the image itself; levels of a tiny image may be empty
};

/// Pixels of a pyramid level in pixels of level 0 and back. Resizing keeps the image's edges, not
/// its first pixel's centre: a level's pixel (0, 0) lies half a level pixel from the edge.
struct LevelScale {
  float x = 1, y = 1;  ///< size of a level pixel, level-0 pixels

  LevelScale(const ImagePyramid& pyramid, int level)
      : x(static_cast<float>(pyramid.levels[0].width) /
          static_cast<float>(pyramid.levels[level].width)),
        y(static_cast<float>(pyramid.levels[0].height) /
          static_cast<float>(pyramid.levels[level].height)) {}

  float to_base_x(float level_x) const { return (level_x + 0.5f) * x - 0.5f; }
  float to_base_y(float level_y) const { return (level_y + 0.5f) * y - 0.5f; }
  float to_level_x(float base_x) const { return (base_x + 0.5f) / x - 0.5f; }
  float to_level_y(float base_y) const { return (base_y + 0.5f) / y - 0.5f; }
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
/// Deterministic; the levels run in parallel on oneTBB, the result does not depend on the number of
/// threads. Not thread-safe: one extractor per thread (it keeps its buffers; no allocation of
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
