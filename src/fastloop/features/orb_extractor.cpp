#include "fastloop/features/orb_extractor.hpp"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <cmath>
#include <opencv2/imgproc.hpp>

#include "fastloop/core/error.hpp"
#include "fastloop/features/blur.hpp"
#include "fastloop/features/corner_detection.hpp"
#include "fastloop/features/cv_view.hpp"
#include "fastloop/features/orb_descriptor.hpp"

namespace fastloop {
namespace {

constexpr double kTwoPi = 6.283185307179586;

/// What one level contributes.
struct LevelResult {
  std::vector<Corner> corners;
  std::vector<PatchDirection> directions;
  std::vector<Descriptor> descriptors;
};

/// Runs body(level) for all levels, in parallel where threads are free. Isolated: while waiting,
/// the calling thread takes no foreign work, which could delay a frame by far more than it saves.
template <class Body>
void for_each_level(int levels, const Body& body) {
  tbb::this_task_arena::isolate([&] {
    tbb::parallel_for(
        tbb::blocked_range<int>(0, levels, 1),
        [&](const tbb::blocked_range<int>& r) {
          for (int l = r.begin(); l < r.end(); ++l) body(l);
        },
        tbb::simple_partitioner{});
  });
}

}  // namespace

void OrbOptions::validate() const {
  const auto require = [](bool ok, const char* message) {
    if (!ok) throw InvalidArgument(std::string("OrbOptions: ") + message);
  };
  require(num_features > 0 && num_features <= 65535, "num_features must be in 1..65535");
  require(levels >= 1 && levels <= 32, "levels must be in 1..32");
  require(scale_factor > 1 && scale_factor <= 4, "scale_factor must be in (1, 4]");
  require(fast_threshold >= 1 && fast_threshold <= 254, "fast_threshold must be in 1..254");
  require(fast_min_threshold >= 1 && fast_min_threshold <= fast_threshold,
          "fast_min_threshold must be in 1..fast_threshold");
}

struct OrbExtractor::Impl {
  explicit Impl(const OrbOptions& o) : options(o), scales(o.levels, o.scale_factor) {
    pyramid.levels.resize(o.levels);
    blurred.resize(o.levels);
    scores.resize(o.levels);
    results.resize(o.levels);
  }

  void build_pyramid(const ImageU8& image);
  void detect(int level);
  void describe_level(int level, int count);
  OrbFeatures collect() const;

  OrbOptions options;
  PyramidScales scales;
  ImagePyramid pyramid;
  std::vector<ImageU8> blurred, scores;
  std::vector<LevelResult> results;
};

void OrbExtractor::Impl::build_pyramid(const ImageU8& image) {
  pyramid.levels[0] = image;
  for (int l = 1; l < options.levels; ++l) {
    ImageU8& level = pyramid.levels[l];
    resize_storage(level, static_cast<int>(std::lround(image.width / scales.scale[l])),
                   static_cast<int>(std::lround(image.height / scales.scale[l])));
    if (level.empty()) continue;  // a tiny image: no features on this level
    cv::Mat target = as_mat(level);
    cv::resize(as_mat(pyramid.levels[l - 1]), target, target.size(), 0, 0, cv::INTER_LINEAR);
  }
}

void OrbExtractor::Impl::detect(int level) {
  const ImageU8& image = pyramid.levels[level];
  LevelResult& result = results[level];
  detect_corners(image, kOrbBorderPx, options.fast_threshold, options.fast_min_threshold,
                 scores[level], result.corners);
  if (result.corners.empty()) return;
  blur_for_description(image, blurred[level]);
}

void OrbExtractor::Impl::describe_level(int level, int count) {
  const ImageU8& image = pyramid.levels[level];
  LevelResult& result = results[level];
  result.corners = spread_evenly(result.corners, count, image.width, image.height);
  const std::size_t n = result.corners.size();
  result.directions.resize(n);
  result.descriptors.resize(n);
  for (std::size_t i = 0; i < n; ++i) {
    Corner& c = result.corners[i];
    refine_corner(image, scores[level], c);
    result.directions[i] = patch_direction(image, c.x, c.y);
    result.descriptors[i] = describe(blurred[level], c.x, c.y, result.directions[i]);
  }
}

OrbFeatures OrbExtractor::Impl::collect() const {
  OrbFeatures f;
  std::size_t n = 0;
  for (const LevelResult& r : results) n += r.corners.size();
  for (auto* v : {&f.x, &f.y, &f.angle_rad, &f.response}) v->reserve(n);
  f.octave.reserve(n);
  f.descriptors.reserve(n);
  for (int l = 0; l < options.levels; ++l) {
    const ImageU8& image = pyramid.levels[l];
    if (image.empty()) continue;
    const LevelScale scale(pyramid, l);
    for (std::size_t i = 0; i < results[l].corners.size(); ++i) {
      const Corner& c = results[l].corners[i];
      const PatchDirection& d = results[l].directions[i];
      f.x.push_back(scale.to_base_x(c.x + c.dx));
      f.y.push_back(scale.to_base_y(c.y + c.dy));
      const double angle = std::atan2(d.sin, d.cos);
      const float positive = static_cast<float>(angle < 0 ? angle + kTwoPi : angle);
      f.angle_rad.push_back(positive < static_cast<float>(kTwoPi) ? positive : 0.f);
      f.response.push_back(c.score);
      f.octave.push_back(static_cast<std::uint8_t>(l));
      f.descriptors.push_back(results[l].descriptors[i]);
    }
  }
  return f;
}

OrbExtractor::OrbExtractor(const OrbOptions& options) {
  options.validate();
  impl_ = std::make_unique<Impl>(options);
}
OrbExtractor::~OrbExtractor() = default;
OrbExtractor::OrbExtractor(OrbExtractor&&) noexcept = default;

OrbFeatures OrbExtractor::extract(const ImageU8& image) {
  if (image.empty()) throw InvalidArgument("OrbExtractor: empty image");
  if (image.width > 32767 || image.height > 32767)
    throw InvalidArgument("OrbExtractor: image larger than 32,767 pixels");
  impl_->build_pyramid(image);
  for_each_level(impl_->options.levels, [&](int l) { impl_->detect(l); });
  std::vector<int> available;
  for (const LevelResult& r : impl_->results)
    available.push_back(static_cast<int>(r.corners.size()));
  const std::vector<int> share =
      share_among_levels(impl_->options.num_features, impl_->options.scale_factor, available);
  for_each_level(impl_->options.levels, [&](int l) { impl_->describe_level(l, share[l]); });
  return impl_->collect();
}

const ImagePyramid& OrbExtractor::pyramid() const {
  return impl_->pyramid;
}
const OrbOptions& OrbExtractor::options() const {
  return impl_->options;
}

}  // namespace fastloop
