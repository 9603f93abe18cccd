#include "fastloop/matching/packed_features.hpp"

#include <gtest/gtest.h>

#include "fastloop/compute/slab_space.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/matching/batch_distances.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::random_scene;
using testing::Scene;
using testing::SceneSize;

/// A block of memory as a device would have it.
struct Packed {
  explicit Packed(const FeatureSet& f) : bytes(packed_bytes(f.size()) / 16 + 1) {
    auto* block = reinterpret_cast<std::byte*>(bytes.data());
    pack_features(f, block);
    view = packed_view(block, static_cast<int>(f.size()), f.grid.cell_width_px,
                       f.grid.cell_height_px);
  }
  struct alignas(16) Unit {
    std::byte bytes[16];
  };
  std::vector<Unit> bytes;
  PackedView view;
};

struct Distance {
  const Descriptor& query;
  const Descriptor* all;
  int operator()(int i) const { return hamming_distance(query, all[i]); }
};

WindowScan random_window(const Scene& scene, std::mt19937& rng) {
  std::uniform_real_distribution<float> u(-1, 1);
  WindowScan w{};
  w.u = (0.5f + 0.6f * u(rng)) * static_cast<float>(scene.rig.left.width);
  w.v = (0.5f + 0.6f * u(rng)) * static_cast<float>(scene.rig.left.height);
  if (rng() % 3 == 0) w.u = w.v = 200.3f;  // where keypoints crowd
  w.radius = 40 * (1 + u(rng));
  w.min_octave = static_cast<int>(rng() % 5);
  w.max_octave = w.min_octave + static_cast<int>(rng() % 4);
  w.right_u = w.u - 10 * u(rng);
  w.right_v = w.v;
  w.right_radius = rng() % 2 ? w.radius : -1;
  w.chi2_mono = rng() % 2 ? 600.0f : 0;
  w.chi2_stereo = rng() % 2 ? 800.0f : 0;
  w.use_right_v = rng() % 2;
  w.max_distance = 100 + static_cast<int>(rng() % 100);
  w.best_to_second = rng() % 2 ? 0.9f : 1;
  return w;
}

TEST(PackedFeatures, ScanOfPackedRowsEqualsScanOfFeatures) {
  std::mt19937 rng(5);
  int found = 0;
  for (unsigned seed = 0; seed < 40; ++seed) {
    SceneSize size;
    size.targets = 2;
    size.clutter = 400;
    size.crowding = seed % 3 == 0 ? 0.7 : 0;
    const Scene scene = random_scene(seed, seed % 2 == 1, size);
    const ScaleView scales{scene.scales.scale.data(), scene.scales.sigma2.data(), 8};
    for (std::size_t t = 0; t < scene.features.size(); ++t) {
      const FeatureView view = make_feature_view(scene.features[t], scene.blocked[t]);
      const Packed packed(scene.features[t]);
      for (int i = 0; i < 60; ++i) {
        const WindowScan w = random_window(scene, rng);
        const Descriptor& query = scene.landmarks.descriptor[rng() % 300];
        const MatchKey expected = scan_window(view, scales, w, query, PortableDistances{});
        for (const int lanes : {1, 3, 8, 32}) {
          BestTwo all;
          for (int lane = lanes; lane-- > 0;)
            all.merge(scan_rows(packed.view, view.blocked, scales, w,
                                Distance{query, packed.view.descriptors}, lane, lanes));
          ASSERT_EQ(best_of(packed.view, w, all), expected) << seed << " " << lanes;
        }
        found += expected != kNoKey;
      }
    }
  }
  EXPECT_GT(found, 500);
}

TEST(PackedFeatures, KeepsEveryKeypoint) {
  const Scene scene = random_scene(3, false, {});
  const FeatureSet& f = scene.features[0];
  const Packed kept(f);
  for (std::size_t k = 0; k < f.size(); ++k) {
    const int at = kept.view.position[k];
    const PackedKeypoint& p = kept.view.keypoints[at];
    EXPECT_EQ(p.x, f.x[k]);
    EXPECT_EQ(p.y, f.y[k]);
    EXPECT_TRUE(p.right_x == f.right_x[k] || std::isnan(f.right_x[k]));
    EXPECT_TRUE(kept.view.right_y[at] == f.right_y[k] || std::isnan(f.right_y[k]));
    EXPECT_EQ(p.index(), static_cast<int>(k));
    EXPECT_EQ(p.octave(), f.octave[k]);
    EXPECT_EQ(kept.view.descriptors[at], f.descriptors[k]);
  }
  EXPECT_EQ(kept.view.size, static_cast<int>(f.size()));
}

TEST(PackedFeatures, EmptyAndBrokenSets) {
  FeatureSet none;
  const Packed packed(none);
  const ScaleView scales{};
  WindowScan w{};
  w.radius = 100;
  w.max_octave = 7;
  EXPECT_EQ(scan_rows(packed.view, nullptr, scales, w, Distance{{}, nullptr}, 0, 1).best, kNoKey);
  FeatureSet broken = random_scene(3, false, {}).features[0];
  broken.octave.pop_back();
  EXPECT_THROW(Packed{broken}, InvalidArgument);
}

TEST(PackedFeatures, LandmarksKeepTheirArrays) {
  const Scene scene = random_scene(4, false, {});
  const auto& l = scene.landmarks;
  const std::size_t n = l.p_world.size();
  const LandmarkArrays from{l.p_world[0].data(), l.normal_world[0].data(), l.min_distance_m.data(),
                            l.max_distance_m.data(), l.descriptor.data()};
  std::vector<Packed::Unit> memory(packed_landmark_bytes(n) / 16 + 1);
  auto* block = reinterpret_cast<std::byte*>(memory.data());
  pack_landmarks(from, n, block);
  const LandmarkArrays to = packed_landmarks(block, n);
  for (std::size_t i = 0; i < n; ++i) {
    EXPECT_EQ(to.descriptor[i], l.descriptor[i]);
    EXPECT_EQ(to.min_distance_m[i], l.min_distance_m[i]);
    EXPECT_EQ(to.max_distance_m[i], l.max_distance_m[i]);
    for (std::size_t k = 0; k < 3; ++k) {
      EXPECT_EQ(to.p_world[3 * i + k], l.p_world[i][static_cast<int>(k)]);
      EXPECT_EQ(to.normal_world[3 * i + k], l.normal_world[i][static_cast<int>(k)]);
    }
  }
}

/// What a device must hold for a large map.
TEST(PackedFeatures, TenThousandKeyframesAndAMillionLandmarksFitInOneGibibyte) {
  SlabSpace space;
  const auto take = [&](std::size_t bytes) {
    if (space.take(bytes)) return;
    space.add_slab(std::max(SlabSpace::rounded(bytes), std::size_t{32} << 20));
    ASSERT_TRUE(space.take(bytes));
  };
  for (int keyframe = 0; keyframe < 10000; ++keyframe) take(packed_bytes(1200));
  take(packed_landmark_bytes(1000000));
  EXPECT_LE(space.bytes_reserved(), std::size_t{1} << 30);
  EXPECT_LE(packed_bytes(1200), 73000u);
}

TEST(ContentId, BelongsToOneObject) {
  FeatureSet a;
  EXPECT_EQ(a.id.value(), 0u);
  const std::uint64_t id = a.id.assign();
  EXPECT_NE(id, 0u);
  EXPECT_EQ(a.id.assign(), id);
  FeatureSet b = a;
  EXPECT_EQ(b.id.value(), 0u);
  EXPECT_NE(b.id.assign(), id);
  b = a;
  EXPECT_EQ(b.id.value(), 0u);
  const FeatureSet c = std::move(a);
  EXPECT_EQ(c.id.value(), 0u);
}

}  // namespace
}  // namespace fastloop::matching
