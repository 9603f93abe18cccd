#include "fastloop/sim/world.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "fastloop/sim/ray_tracer.hpp"
#include "fastloop/sim/rig.hpp"

namespace fastloop::sim {
namespace {

class Worlds : public ::testing::TestWithParam<WorldKind> {
 protected:
  Trajectory motion(double seconds) const {
    return make_motion(GetParam(), seconds, 2, carrier_from_body(make_rig(CameraKind::kPinhole)));
  }
};

TEST_P(Worlds, MotionNeverComesNearASurface) {
  const std::vector<Vector3d> path = sample_path(motion(default_seconds(GetParam())));
  const World world = make_world(GetParam(), 9, path);
  EXPECT_GT(clearance(world, path), 0.35);
}

TEST_P(Worlds, IsClosedUnlessThereIsASky) {
  const Trajectory x = motion(20);
  const World world = make_world(GetParam(), 9, sample_path(x));
  const Bvh bvh = build_bvh(world.surfaces);
  const TracedView view(world, bvh, x.pose(10));
  Random random(1);
  RayPacket rays{};
  PacketHits hits;
  int sky = 0;
  for (int k = 0; k < 200; ++k) {
    for (int l = 0; l < kLanes; ++l) {
      const Vector3d d = Vector3d(random.normal(), random.normal(), random.normal()).normalized();
      rays.x[l] = static_cast<float>(d.x());
      rays.y[l] = static_cast<float>(d.y());
      rays.z[l] = static_cast<float>(d.z());
    }
    view.trace(rays, hits);
    for (int l = 0; l < kLanes; ++l) sky += hits.surface[l] == kSky;
  }
  if (GetParam() == WorldKind::kCampus)
    EXPECT_GT(sky, 100);
  else
    EXPECT_EQ(sky, 0);
}

TEST_P(Worlds, HierarchyFindsWhatTryingEverySurfaceFinds) {
  const Trajectory x = motion(20);
  const World world = make_world(GetParam(), 4, sample_path(x));
  const Bvh bvh = build_bvh(world.surfaces);
  const SE3 T_world_camera = x.pose(7);
  const TracedView view(world, bvh, T_world_camera);
  Random random(2);
  RayPacket rays{};
  PacketHits hits;
  for (int k = 0; k < 40; ++k) {
    const Vector3d centre = Vector3d(random.normal(), random.normal(), random.normal()).normalized();
    for (int l = 0; l < kLanes; ++l) {
      const double spread = k % 2 ? 0.02 : 1.0;  // coherent and wild packets
      const Vector3d d =
          (centre + spread * Vector3d(random.normal(), random.normal(), random.normal())).normalized();
      rays.x[l] = static_cast<float>(d.x());
      rays.y[l] = static_cast<float>(d.y());
      rays.z[l] = static_cast<float>(d.z());
    }
    view.trace(rays, hits);
    for (int l = 0; l < kLanes; ++l) {
      const Vector3d d = T_world_camera.rotation * Vector3d(rays.x[l], rays.y[l], rays.z[l]);
      double nearest = std::numeric_limits<double>::infinity();
      for (const Surface& s : world.surfaces) {
        const Vector3d r = s.origin - T_world_camera.translation;
        const double t = s.normal().dot(r) / s.normal().dot(d);
        const Vector3d p = t * d - r;
        const double a = p.dot(s.axis_a), b = p.dot(s.axis_b);
        if (t > 1e-3 && a >= 0 && b >= 0 && a <= s.length_a && b <= s.length_b) nearest = std::min(nearest, t);
      }
      if (std::isinf(nearest)) continue;  // edges are padded by a fraction of a millimetre
      EXPECT_LE(hits.distance[l], nearest * (1 + 1e-4) + 1e-4);
      EXPECT_NE(hits.surface[l], kSky);
    }
  }
}

TEST_P(Worlds, FollowsFromTheSeed) {
  const std::vector<Vector3d> path = sample_path(motion(5));
  const World a = make_world(GetParam(), 1, path), b = make_world(GetParam(), 1, path);
  const World c = make_world(GetParam(), 2, path);
  ASSERT_EQ(a.surfaces.size(), b.surfaces.size());
  for (std::size_t i = 0; i < a.surfaces.size(); ++i) {
    EXPECT_EQ(a.surfaces[i].seed, b.surfaces[i].seed);
    EXPECT_EQ(a.surfaces[i].origin, b.surfaces[i].origin);
  }
  EXPECT_NE(a.surfaces[0].seed, c.surfaces[0].seed);
}

INSTANTIATE_TEST_SUITE_P(Kinds, Worlds,
                         ::testing::Values(WorldKind::kRoom, WorldKind::kHall, WorldKind::kCorridor,
                                           WorldKind::kCampus, WorldKind::kRing,
                                           WorldKind::kCloister),
                         [](const auto& i) { return to_string(i.param); });

TEST(WorldAround, EnclosesAnyMotion) {
  const std::vector<Vector3d> path = {{10, 20, 5}, {13, 21, 5.5}, {11, 24, 4.8}};
  const World world = make_world_around(3, path);
  EXPECT_GT(clearance(world, path), 0.4);
  for (const Vector3d& p : path)
    EXPECT_TRUE(((p - world.low).array() > 0).all() && ((world.high - p).array() > 0).all());
}

}  // namespace
}  // namespace fastloop::sim
