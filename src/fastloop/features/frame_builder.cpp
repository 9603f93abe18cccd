#include "fastloop/features/frame_builder.hpp"

#include <tbb/parallel_invoke.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <limits>
#include <opencv2/core/utility.hpp>
#include <optional>

#include "fastloop/core/error.hpp"
#include "fastloop/features/rectification.hpp"
#include "fastloop/features/stereo_matching.hpp"

namespace fastloop {
namespace {

enum class Mode { kRectifiedPair, kGeneralPair, kDepth };

Mode mode_of(const Calibration& calibration) {
  const auto& cameras = calibration.cameras;
  for (const CameraCalibration& c : cameras)
    if (const auto problem = c.camera.problem()) throw InvalidArgument("calibration: " + *problem);
  if (cameras.size() == 1 && calibration.depth) {
    if (cameras[0].camera.model != CameraModel::kPinhole)
      throw InvalidArgument("calibration: an RGB-D camera must be a pinhole");
    if (!(calibration.depth->virtual_baseline_m > 0))
      throw InvalidArgument("calibration: the virtual baseline must be positive");
    return Mode::kDepth;
  }
  if (cameras.size() != 2)
    throw InvalidArgument("calibration: expected two cameras, or one camera with depth");
  if (cameras[0].camera.model != cameras[1].camera.model)
    throw InvalidArgument("calibration: the two cameras have different models");
  if (cameras[0].camera.width != cameras[1].camera.width ||
      cameras[0].camera.height != cameras[1].camera.height)
    throw InvalidArgument("calibration: the two cameras have different image sizes");
  return cameras[0].camera.model == CameraModel::kPinhole ? Mode::kRectifiedPair
                                                          : Mode::kGeneralPair;
}

StereoRig general_rig(const CameraCalibration& left, const CameraCalibration& right) {
  StereoRig rig;
  rig.kind = StereoRig::Kind::kGeneral;
  rig.left = left.camera;
  rig.right = right.camera;
  rig.T_right_left = right.T_body_camera.inverse() * left.T_body_camera;
  rig.T_body_left = left.T_body_camera;
  rig.baseline_m = rig.T_right_left.translation.norm();
  if (!(rig.T_right_left.is_finite() && rig.baseline_m > 1e-6))
    throw InvalidArgument("calibration: the two cameras must be finitely far apart");
  return rig;
}

template <class T>
void require_size(const Image<T>& image, const Camera& camera, const char* what) {
  const std::string size = std::to_string(image.width) + " x " + std::to_string(image.height);
  if (image.width != camera.width || image.height != camera.height)
    throw InvalidArgument(std::string(what) + " image is " + size + ", the calibration says " +
                          std::to_string(camera.width) + " x " + std::to_string(camera.height));
  if (image.pixels.size() != static_cast<std::size_t>(image.width) * image.height)
    throw InvalidArgument(std::string(what) + " image of " + size + " holds " +
                          std::to_string(image.pixels.size()) + " pixels");
}

/// Depth at a pixel: that of the nearest pixel where it is known, else the median of its known
/// neighbours; 0 when unknown.
float depth_at(const ImageF32& depth, double x, double y, float max_depth_m) {
  const int cx = static_cast<int>(std::lround(x)), cy = static_cast<int>(std::lround(y));
  const auto valid = [&](float d) { return d > 0 && d <= max_depth_m; };  // false for NaN
  if (cx < 0 || cy < 0 || cx >= depth.width || cy >= depth.height) return 0;
  if (valid(depth.at(cx, cy))) return depth.at(cx, cy);
  std::array<float, 9> known;
  int count = 0;
  for (int v = std::max(0, cy - 1); v <= std::min(depth.height - 1, cy + 1); ++v)
    for (int u = std::max(0, cx - 1); u <= std::min(depth.width - 1, cx + 1); ++u)
      if (valid(depth.at(u, v))) known[count++] = depth.at(u, v);
  if (count < 3) return 0;
  std::nth_element(known.begin(), known.begin() + count / 2, known.begin() + count);
  return known[count / 2];
}

}  // namespace

struct FrameBuilder::Impl {
  Impl(const Calibration& calibration, const OrbOptions& options);

  void check(const FrameInput& input) const;
  void attach_depth(const ImageF32& depth, FeatureSet& frame) const;

  Mode mode;
  CameraCalibration recorded_left;
  DepthCalibration depth;
  std::optional<Rectification> rectification;
  StereoRig rig;
  PyramidScales scales;
  StereoMatchOptions matching;
  OrbExtractor left, right;
  ImageU8 rectified_left, rectified_right;
};

FrameBuilder::Impl::Impl(const Calibration& calibration, const OrbOptions& options)
    : mode(mode_of(calibration)),
      recorded_left(calibration.cameras[0]),
      scales(options.levels, options.scale_factor),
      left(options),
      right(options) {
  // Parallelism is ours: OpenCV's own threads would compete with it. The setting is process-wide.
  cv::setNumThreads(1);
  switch (mode) {
    case Mode::kRectifiedPair:
      rectification = Rectification::of_pair(calibration.cameras[0], calibration.cameras[1]);
      rig = rectification->rig();
      break;
    case Mode::kGeneralPair:
      rig = general_rig(calibration.cameras[0], calibration.cameras[1]);
      break;
    case Mode::kDepth:
      depth = *calibration.depth;
      rectification = Rectification::of_camera(calibration.cameras[0]);
      rig = rectification->rig();
      rig.baseline_m = depth.virtual_baseline_m;
      rig.T_right_left = SE3(Eigen::Quaterniond::Identity(), Vector3d(-rig.baseline_m, 0, 0));
      break;
  }
}

void FrameBuilder::Impl::check(const FrameInput& input) const {
  require_size(input.left, rig.left, "left");
  if (mode == Mode::kDepth)
    require_size(input.depth, rig.left, "depth");
  else
    require_size(input.right, rig.right, "right");
}

void FrameBuilder::Impl::attach_depth(const ImageF32& image, FeatureSet& frame) const {
  const bool distorted = rectification->needed();
  const float focal_baseline = static_cast<float>(rig.left.fx * rig.baseline_m);
  for (std::size_t i = 0; i < frame.size(); ++i) {
    Eigen::Vector2d pixel(frame.x[i], frame.y[i]);
    if (distorted) pixel = recorded_left.camera.project(rig.left.unproject(pixel));
    const float d = depth_at(image, pixel.x(), pixel.y(), static_cast<float>(depth.max_depth_m));
    if (d <= 0) continue;
    frame.depth_m[i] = d;
    frame.right_x[i] = frame.x[i] - focal_baseline / d;
    frame.right_y[i] = frame.y[i];
  }
}

FrameBuilder::FrameBuilder(const Calibration& calibration, const OrbOptions& options)
    : impl_(std::make_unique<Impl>(calibration, options)) {}
FrameBuilder::~FrameBuilder() = default;

const StereoRig& FrameBuilder::rig() const {
  return impl_->rig;
}

namespace {

FeatureSet without_stereo(OrbFeatures&& f, int width, int height) {
  FeatureSet frame;
  frame.right_x.assign(f.size(), std::numeric_limits<float>::quiet_NaN());
  frame.right_y.assign(f.size(), std::numeric_limits<float>::quiet_NaN());
  frame.depth_m.assign(f.size(), 0.f);
  frame.image_width = width;
  frame.image_height = height;
  frame.grid.build(f.x, f.y, width, height);
  frame.x = std::move(f.x);
  frame.y = std::move(f.y);
  frame.angle_rad = std::move(f.angle_rad);
  frame.octave = std::move(f.octave);
  frame.descriptors = std::move(f.descriptors);
  return frame;
}

}  // namespace

FeatureSet FrameBuilder::build(const FrameInput& input, StageTimes* times) {
  Impl& s = *impl_;
  s.check(input);
  const bool pair = s.mode != Mode::kDepth;
  const bool rectify = s.rectification && s.rectification->needed();
  FeatureSet frame;
  // Isolated: a thread that waits here must not pick up somebody else's long task.
  tbb::this_task_arena::isolate([&] {
    const auto both = [pair](const auto& on_left, const auto& on_right) {
      pair ? tbb::parallel_invoke(on_left, on_right) : on_left();
    };
    if (rectify) {
      ScopedTimer timer(times, "rectify");
      both([&] { s.rectification->apply(0, input.left, s.rectified_left); },
           [&] { s.rectification->apply(1, input.right, s.rectified_right); });
    }
    OrbFeatures left, right;
    {
      ScopedTimer timer(times, "orb");
      both([&] { left = s.left.extract(rectify ? s.rectified_left : input.left); },
           [&] { right = s.right.extract(rectify ? s.rectified_right : input.right); });
    }
    ScopedTimer timer(times, "stereo");
    OrbFeatures copy = left;
    frame = without_stereo(std::move(copy), s.rig.left.width, s.rig.left.height);
    const StereoView left_view{left, s.left.pyramid()}, right_view{right, s.right.pyramid()};
    switch (s.mode) {
      case Mode::kRectifiedPair:
        match_rectified(s.rig, s.scales, left_view, right_view, s.matching, frame);
        break;
      case Mode::kGeneralPair:
        match_general(s.rig, s.scales, left_view, right_view, s.matching, frame);
        break;
      case Mode::kDepth:
        s.attach_depth(input.depth, frame);
        break;
    }
  });
  return frame;
}

}  // namespace fastloop
