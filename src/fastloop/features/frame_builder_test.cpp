#include "fastloop/features/frame_builder.hpp"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <cmath>
#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/features/scene_for_tests.hpp"

namespace fastloop {
namespace {

using synthetic_scene::TexturedPlane;

SE3 pose(const Vector3d& rotation, const Vector3d& translation) {
  return SE3(so3::exp(rotation), translation);
}

/// A converging, distorted pair, cameras turned against the body.
Calibration pinhole_pair() {
  Calibration c;
  Camera camera{CameraModel::kPinhole,         752, 480, 458.6, 457.3, 367.2, 248.4,
                {-0.283, 0.074, 2e-4, 2e-5, 0}};
  const SE3 T_body_left = pose({0.1, -0.2, 1.5}, {0.02, 0.05, 0.01});
  c.cameras.push_back({camera, T_body_left, 20});
  camera.fx = 457.6, camera.cx = 380, camera.cy = 255;
  c.cameras.push_back(
      {camera, T_body_left * pose({0.008, -0.006, 0.01}, {0.11, 0.001, -0.0008}), 20});
  return c;
}

Calibration fisheye_pair() {
  Calibration c;
  Camera camera{CameraModel::kKannalaBrandt,        512, 512, 190.98, 190.97, 254.9, 256.9,
                {0.0035, 0.0007, -0.002, 0.0002, 0}};
  c.cameras.push_back({camera, pose({0.02, 0.3, -0.1}, {0.04, -0.07, -0.04}), 20});
  camera.fx = 190.4, camera.cx = 252.6;
  c.cameras.push_back(
      {camera, c.cameras[0].T_body_camera * pose({0.047, 0.001, -0.002}, {0.1, 0.002, 0.001}), 20});
  return c;
}

Calibration depth_camera() {
  Calibration c;
  c.cameras.push_back({{CameraModel::kPinhole, 640, 480, 520, 521, 318, 243, {}}, SE3(), 30});
  c.depth = DepthCalibration{};
  return c;
}

/// A slanted wall before the left camera.
TexturedPlane wall_before(const SE3& T_world_left, double distance_m) {
  const SE3 T_world_wall = T_world_left * pose({0.15, -0.3, 0.2}, {0, 0, distance_m});
  TexturedPlane plane;
  plane.origin = T_world_wall.translation;
  plane.right = T_world_wall.rotation * Vector3d::UnitX();
  plane.down = T_world_wall.rotation * Vector3d::UnitY();
  plane.texels_per_metre = 350 / distance_m;
  plane.texture = synthetic_scene::textured_image(1600, 1400, 17);
  return plane;
}

/// A frame of a wall, the body at the world's origin.
struct Scene {
  explicit Scene(const Calibration& c, double distance_m) : calibration(c) {
    wall = wall_before(c.cameras[0].T_body_camera, distance_m);
    input.left = wall.render(c.cameras[0].camera, c.cameras[0].T_body_camera,
                             c.depth ? &input.depth : nullptr);
    if (c.cameras.size() == 2)
      input.right = wall.render(c.cameras[1].camera, c.cameras[1].T_body_camera);
  }
  /// The point a left pixel of the rig shows, in the rig's left camera frame.
  Vector3d truth(const StereoRig& rig, double x, double y) const {
    const Vector3d ray = rig.left.unproject({x, y});
    return wall.hit(rig.T_body_left.translation, rig.T_body_left.rotation * ray) * ray;
  }
  Calibration calibration;
  TexturedPlane wall;
  FrameInput input;
};

double median(std::vector<double> v) {
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

struct StereoErrors {
  std::size_t with_depth = 0;
  double median_px = 0, outlier_share = 0, median_depth = 0;
};

/// Right coordinates and depths against the truth.
StereoErrors errors_of(const Scene& scene, const StereoRig& rig, const FeatureSet& f) {
  std::vector<double> pixels, depths;
  int outliers = 0;
  for (std::size_t i = 0; i < f.size(); ++i) {
    EXPECT_EQ(f.has_depth(i), !std::isnan(f.right_x[i]));
    if (!f.has_depth(i)) continue;
    const Vector3d p = scene.truth(rig, f.x[i], f.y[i]);
    StereoRig::Residual r;
    const PixelObservation z{{f.x[i], f.y[i]}, {f.right_x[i], f.right_y[i]}};
    const int rows = rig.residual(p, z, &r);
    EXPECT_EQ(rows, rig.residual_size(z));
    pixels.push_back(rows == 3 ? std::abs(r(2)) : std::hypot(r(2), r(3)));
    outliers += pixels.back() > 2 * std::pow(1.2, f.octave[i]);
    depths.push_back(std::abs(f.depth_m[i] / p.z() - 1));
  }
  if (pixels.empty()) return {};
  return {pixels.size(), median(pixels), outliers / static_cast<double>(pixels.size()),
          median(depths)};
}

TEST(FrameBuilder, MatchesADistortedPinholePair) {
  const Scene scene(pinhole_pair(), 2.5);
  FrameBuilder builder(scene.calibration, {});
  const StereoRig& rig = builder.rig();
  EXPECT_EQ(rig.kind, StereoRig::Kind::kRectified);
  EXPECT_TRUE(rig.left.is_ideal_pinhole());
  EXPECT_NEAR(rig.baseline_m, 0.11, 1e-3);
  EXPECT_EQ(rig.T_right_left.translation.x(), -rig.baseline_m);
  // Rectification turns the left camera and leaves it where it is.
  EXPECT_LT(
      (rig.T_body_left.translation - scene.calibration.cameras[0].T_body_camera.translation).norm(),
      1e-12);

  StageTimes times;
  const FeatureSet f = builder.build(scene.input, &times);
  EXPECT_EQ(f.size(), 1200u);
  const StereoErrors e = errors_of(scene, rig, f);
  EXPECT_GT(e.with_depth, 600u);
  EXPECT_LT(e.median_px, 0.15);
  EXPECT_LT(e.outlier_share, 0.02);
  EXPECT_LT(e.median_depth, 0.01);
  EXPECT_EQ(f.grid.indices.size(), f.size());
  for (const char* stage : {"rectify", "orb", "stereo"})
    EXPECT_EQ(times.samples(stage).size(), 1u) << stage;
}

TEST(FrameBuilder, LeavesARectifiedPairAsItIs) {
  Calibration c;
  const Camera camera{CameraModel::kPinhole, 900, 370, 718.9, 718.9, 440, 185, {}};
  c.cameras.push_back({camera, SE3(), 10});
  c.cameras.push_back({camera, pose({0, 0, 0}, {0.537, 0, 0}), 10});
  const Scene scene(c, 12);
  FrameBuilder builder(c, {});
  EXPECT_EQ(builder.rig().left.fx, camera.fx);
  EXPECT_EQ(builder.rig().left.cx, camera.cx);
  EXPECT_EQ(builder.rig().baseline_m, 0.537);
  StageTimes times;
  const StereoErrors e = errors_of(scene, builder.rig(), builder.build(scene.input, &times));
  EXPECT_TRUE(times.samples("rectify").empty());
  EXPECT_GT(e.with_depth, 600u);
  EXPECT_LT(e.median_px, 0.1);
  EXPECT_LT(e.outlier_share, 0.02);
}

TEST(FrameBuilder, MatchesAFisheyePair) {
  const Scene scene(fisheye_pair(), 1.5);
  FrameBuilder builder(scene.calibration, {});
  EXPECT_EQ(builder.rig().kind, StereoRig::Kind::kGeneral);
  const StereoErrors e = errors_of(scene, builder.rig(), builder.build(scene.input));
  EXPECT_GT(e.with_depth, 400u);
  EXPECT_LT(e.median_px, 0.15);
  EXPECT_LT(e.outlier_share, 0.02);
  EXPECT_LT(e.median_depth, 0.015);
}

TEST(FrameBuilder, ReadsDepthAndGivesAVirtualRightCoordinate) {
  Scene scene(depth_camera(), 2);
  // A hole, and depth beyond the range.
  for (int y = 0; y < 480; ++y)
    for (int x = 0; x < 320; ++x)
      scene.input.depth.at(x, y) = y < 240 ? std::numeric_limits<float>::quiet_NaN() : 50.f;
  FrameBuilder builder(scene.calibration, {});
  const StereoRig& rig = builder.rig();
  const FeatureSet f = builder.build(scene.input);
  EXPECT_GT(f.size(), 1000u);
  int holes = 0;
  for (std::size_t i = 0; i < f.size(); ++i) {
    if (f.x[i] < 318) {
      EXPECT_FALSE(f.has_depth(i));
      EXPECT_TRUE(std::isnan(f.right_x[i]));
      ++holes;
    }
  }
  EXPECT_GT(holes, 300);
  const StereoErrors e = errors_of(scene, rig, f);
  EXPECT_GT(e.with_depth, 400u);
  EXPECT_LT(e.median_px, 0.05);
  EXPECT_EQ(e.outlier_share, 0);
}

TEST(FrameBuilder, RemovesTheDistortionOfADepthCamera) {
  Calibration c = depth_camera();
  c.cameras[0].camera.distortion = {0.2, -0.4, 0.001, 0.002, 0.1};
  const Scene scene(c, 2);
  FrameBuilder builder(c, {});
  EXPECT_TRUE(builder.rig().left.is_ideal_pinhole());
  const StereoErrors e = errors_of(scene, builder.rig(), builder.build(scene.input));
  EXPECT_GT(e.with_depth, 800u);
  EXPECT_LT(e.median_px, 0.05);
}

void expect_equal(const FeatureSet& a, const FeatureSet& b) {
  EXPECT_EQ(a.x, b.x);
  EXPECT_EQ(a.y, b.y);
  EXPECT_EQ(a.octave, b.octave);
  EXPECT_EQ(a.descriptors, b.descriptors);
  EXPECT_EQ(a.depth_m, b.depth_m);
  ASSERT_EQ(a.right_x.size(), b.right_x.size());
  for (std::size_t i = 0; i < a.right_x.size(); ++i) {
    EXPECT_TRUE(a.right_x[i] == b.right_x[i] ||
                (std::isnan(a.right_x[i]) && std::isnan(b.right_x[i])));
  }
}

TEST(FrameBuilder, IsTheSameForAnyNumberOfThreads) {
  for (const Calibration& c : {pinhole_pair(), fisheye_pair()}) {
    const Scene scene(c, 2);
    FrameBuilder builder(c, {});
    const FeatureSet parallel = builder.build(scene.input);
    tbb::global_control one_thread(tbb::global_control::max_allowed_parallelism, 1);
    expect_equal(builder.build(scene.input), parallel);
    FrameBuilder fresh(c, {});
    expect_equal(fresh.build(scene.input), parallel);
  }
}

TEST(FrameBuilder, MeetsImagesWithoutTexture) {
  for (const Calibration& c : {pinhole_pair(), fisheye_pair(), depth_camera()}) {
    const Camera& camera = c.cameras[0].camera;
    FrameInput input;
    input.left = ImageU8(camera.width, camera.height);
    if (c.depth)
      input.depth = ImageF32(camera.width, camera.height);
    else
      input.right = input.left;
    FrameBuilder builder(c, {});
    const FeatureSet f = builder.build(input);
    EXPECT_EQ(f.size(), 0u);
    EXPECT_EQ(f.grid.start.back(), 0u);
    // Texture on one side only: features without depth.
    if (c.depth) continue;
    input.left = synthetic_scene::textured_image(camera.width, camera.height, 3);
    const FeatureSet one_sided = builder.build(input);
    EXPECT_GT(one_sided.size(), 500u);
    for (std::size_t i = 0; i < one_sided.size(); ++i) EXPECT_FALSE(one_sided.has_depth(i));
  }
}

TEST(FrameBuilder, RefusesWhatItCannotUse) {
  const auto refused = [](Calibration c, auto change) {
    change(c);
    EXPECT_THROW(FrameBuilder(c, {}), InvalidArgument);
  };
  refused(pinhole_pair(), [](Calibration& c) { c.cameras.clear(); });
  refused(pinhole_pair(), [](Calibration& c) { c.cameras.pop_back(); });
  refused(pinhole_pair(), [](Calibration& c) { c.cameras[1] = fisheye_pair().cameras[1]; });
  refused(pinhole_pair(), [](Calibration& c) { std::swap(c.cameras[0], c.cameras[1]); });
  refused(pinhole_pair(),
          [](Calibration& c) { c.cameras[1].T_body_camera = c.cameras[0].T_body_camera; });
  refused(pinhole_pair(), [](Calibration& c) { c.cameras[1].camera.width = 640; });
  refused(pinhole_pair(), [](Calibration& c) { c.cameras[0].camera.fx = -1; });
  refused(fisheye_pair(),
          [](Calibration& c) { c.cameras[1].T_body_camera = c.cameras[0].T_body_camera; });
  refused(depth_camera(), [](Calibration& c) { c.depth->virtual_baseline_m = 0; });
  refused(depth_camera(),
          [](Calibration& c) { c.cameras[0].camera.model = CameraModel::kKannalaBrandt; });

  FrameBuilder builder(pinhole_pair(), {});
  FrameInput input;
  EXPECT_THROW(builder.build(input), InvalidArgument);
  input.left = ImageU8(752, 480);
  EXPECT_THROW(builder.build(input), InvalidArgument);
  input.right = ImageU8(752, 479);
  EXPECT_THROW(builder.build(input), InvalidArgument);
  FrameBuilder rgbd(depth_camera(), {});
  input.left = ImageU8(640, 480);
  EXPECT_THROW(rgbd.build(input), InvalidArgument);
}

}  // namespace
}  // namespace fastloop
