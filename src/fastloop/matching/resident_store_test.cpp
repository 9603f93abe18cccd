#include "fastloop/matching/resident_store.hpp"

#include "fastloop/matching/device_for_tests.hpp"
#include "fastloop/matching/expectations_for_tests.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::expect_equal;
using testing::random_scene;
using testing::rule;
using testing::Scene;
using testing::SceneSize;

using Shared = std::shared_ptr<const FeatureSet>;

class ResidentStoreTest : public testing::OnDevice {
 protected:
  void SetUp() override {
    OnDevice::SetUp();
    if (!session_) return;
    store_ = resident_store(*session_);
    ASSERT_NE(store_, nullptr);
  }
  /// Searches a scene in shared copies of its features, as the map holds them.
  void expect_parity(const Scene& scene, std::span<const Shared> features) {
    auto targets = scene.targets();
    for (std::size_t t = 0; t < targets.size(); ++t) targets[t].features = features[t].get();
    const auto search = [&](const Executor& executor) {
      std::vector<ProjectionMatches> found(targets.size());
      search_by_projection(executor, scene.rig, scene.scales, targets, scene.landmarks.view(),
                           rule(1), found);
      return found;
    };
    const auto expected = search(Executor::reference()), found = search(device());
    for (std::size_t t = 0; t < targets.size(); ++t) expect_equal(expected[t], found[t]);
  }
  static std::vector<Shared> shared(const Scene& scene) {
    std::vector<Shared> features;
    for (const FeatureSet& f : scene.features)
      features.push_back(std::make_shared<const FeatureSet>(f));
    return features;
  }
  static Scene scene_of(int targets) {
    SceneSize size;
    size.targets = targets;
    size.landmarks = 600;
    return random_scene(12, false, size);
  }

  std::shared_ptr<ResidentStore> store_;
};

TEST_F(ResidentStoreTest, UploadsOnceInOneCopyWithoutWaiting) {
  const Scene scene = scene_of(4);
  const auto features = shared(scene);
  for (const Shared& f : features) {
    const CudaCounters before = session_->counters();
    store_->prefetch(f);
    CudaCounters after = session_->counters();
    EXPECT_EQ(after.bytes_to_device - before.bytes_to_device, packed_bytes(f->size()));
    EXPECT_EQ(after.synchronizations, before.synchronizations);
    store_->prefetch(f);
    EXPECT_EQ(session_->counters().bytes_to_device, after.bytes_to_device);
    EXPECT_TRUE(store_->contains(*f));
  }
  EXPECT_EQ(store_->statistics().uploads, features.size());
  expect_parity(scene, features);
  // What is resident is not sent again: a call takes landmarks, masks and poses.
  const CudaCounters before = session_->counters();
  expect_parity(scene, features);
  const std::size_t landmarks = packed_landmark_bytes(scene.landmarks.p_world.size());
  EXPECT_LT(session_->counters().bytes_to_device - before.bytes_to_device, landmarks + 20000);
}

TEST_F(ResidentStoreTest, LandmarksStayForSeveralSearches) {
  const Scene scene = scene_of(3);
  const auto targets = scene.targets();
  LandmarkView view = scene.landmarks.view();
  const auto search = [&](const Executor& executor) {
    std::vector<ProjectionMatches> found(targets.size());
    search_by_projection(executor, scene.rig, scene.scales, targets, view, rule(1), found);
    return found;
  };
  const auto expected = search(Executor::reference());
  const std::size_t taken = store_->statistics().bytes_taken;
  auto resident = make_resident(device(), view);
  ASSERT_NE(resident, nullptr);
  EXPECT_GE(store_->statistics().bytes_taken - taken, packed_landmark_bytes(view.size()));
  view.resident = resident.get();
  for (int i = 0; i < 3; ++i) {
    const auto found = search(device());
    for (std::size_t t = 0; t < targets.size(); ++t) expect_equal(expected[t], found[t]);
  }
  // Another session does not know them.
  if (const auto other = CudaSession::open()) {
    const auto found = search(Executor::cuda(other));
    for (std::size_t t = 0; t < targets.size(); ++t) expect_equal(expected[t], found[t]);
  }
  resident.reset();
  EXPECT_EQ(store_->statistics().bytes_taken, taken);
}

TEST_F(ResidentStoreTest, GrowsBeyondAThousandWithoutMoving) {
  store_->set_slab(1 << 20);
  const Scene scene = scene_of(3);
  std::vector<Shared> all;
  std::size_t bytes = 0;
  for (int i = 0; i < 1500; ++i) {
    all.push_back(std::make_shared<const FeatureSet>(scene.features[static_cast<std::size_t>(i) % 3]));
    store_->prefetch(all.back());
    bytes += SlabSpace::rounded(packed_bytes(all.back()->size()));
  }
  const ResidentStatistics s = store_->statistics();
  EXPECT_EQ(s.feature_sets, 1500u);
  EXPECT_EQ(s.bytes_taken, bytes);
  EXPECT_LT(s.bytes_reserved, bytes + bytes / 10 + (2 << 20));
  EXPECT_EQ(s.evictions, 0u);
  EXPECT_GE(session_->counters().reserved_bytes, s.bytes_reserved);
  for (std::size_t first = 0; first < all.size(); first += 123)
    expect_parity(scene, std::span(all).subspan(first / 3 * 3, 3));
}

TEST_F(ResidentStoreTest, EvictsWhatWasUsedLeastRecentlyAndLosesNothing) {
  const Scene scene = scene_of(6);
  const auto features = shared(scene);
  std::size_t largest = 0;
  for (const Shared& f : features)
    largest = std::max(largest, SlabSpace::rounded(packed_bytes(f->size())));
  store_->set_budget(3 * largest);
  for (int round = 0; round < 3; ++round) {
    for (const Shared& f : features) {
      store_->prefetch(f);
      EXPECT_TRUE(store_->contains(*f));
      EXPECT_LE(store_->statistics().bytes_taken, 3 * largest);
    }
    expect_parity(scene, features);  // some are resident, some come with the call
  }
  EXPECT_GT(store_->statistics().evictions, 6u);
  EXPECT_FALSE(store_->contains(*features[0]));
  EXPECT_TRUE(store_->contains(*features[5]));
  store_->set_budget(0);
  EXPECT_EQ(store_->statistics().feature_sets, 0u);
  expect_parity(scene, features);
  EXPECT_EQ(make_resident(device(), scene.landmarks.view()), nullptr);
}

TEST_F(ResidentStoreTest, ErasedAndDeadSetsMakeRoom) {
  const Scene scene = scene_of(3);
  auto features = shared(scene);
  for (const Shared& f : features) store_->prefetch(f);
  store_->erase(*features[1]);
  EXPECT_FALSE(store_->contains(*features[1]));
  expect_parity(scene, features);
  const std::size_t reserved = store_->statistics().bytes_reserved;
  for (int i = 0; i < 2000; ++i)
    store_->prefetch(std::make_shared<const FeatureSet>(scene.features[2]));  // dies at once
  EXPECT_LT(store_->statistics().feature_sets, 20u);
  EXPECT_EQ(store_->statistics().bytes_reserved, reserved);
  EXPECT_TRUE(store_->contains(*features[0]));
  expect_parity(scene, features);
}

TEST_F(ResidentStoreTest, FailedUploadIsMadeUpFor) {
  const Scene scene = scene_of(2);
  const auto features = shared(scene);
  store_->prefetch(std::make_shared<const FeatureSet>(scene.features[0]));  // there is a slab now
  const std::size_t taken = store_->statistics().bytes_taken;
  for (int n = 1; n <= 4; ++n) {
    session_->inject_failure(n, false);
    store_->prefetch(features[0]);
    session_->inject_failure(0, false);
    if (store_->contains(*features[0])) store_->erase(*features[0]);
    EXPECT_LE(store_->statistics().bytes_taken, taken);
  }
  expect_parity(scene, features);
  store_->prefetch(features[0]);
  EXPECT_TRUE(store_->contains(*features[0]));
  expect_parity(scene, features);
}

}  // namespace
}  // namespace fastloop::matching
