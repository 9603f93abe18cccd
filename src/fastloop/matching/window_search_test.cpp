#include <gtest/gtest.h>

#include <cmath>
#include <map>

#include "fastloop/core/error.hpp"
#include "fastloop/matching/camera_view.hpp"
#include "fastloop/matching/projection_search.hpp"
#include "fastloop/matching/rotation_histogram.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

namespace fastloop::matching {
namespace {

using testing::add_keypoint;
using testing::finish;

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

/// Keypoint of each query by comparing it with all keypoints; then claims and rotations, by the
/// header's text.
std::vector<std::int32_t> brute_force(const FeatureSet& f, const std::vector<WindowQuery>& queries,
                                      const WindowSearchOptions& options,
                                      const std::vector<std::uint8_t>& blocked) {
  std::vector<std::int32_t> result(queries.size(), kNoMatch);
  std::map<int, std::pair<int, int>> owner;  // keypoint -> (distance, query)
  for (int q = 0; q < static_cast<int>(queries.size()); ++q) {
    const WindowQuery& w = queries[q];
    std::vector<std::pair<int, int>> found;
    for (int k = 0; k < static_cast<int>(f.size()); ++k) {
      if (!blocked.empty() && blocked[k]) continue;
      if (f.octave[k] < w.min_octave || f.octave[k] > w.max_octave) continue;
      if (std::abs(f.x[k] - w.pixel.x()) > w.radius_px) continue;
      if (std::abs(f.y[k] - w.pixel.y()) > w.radius_px) continue;
      if (!std::isnan(w.right_x) && std::abs(f.right_x[k] - w.right_x) > w.radius_px) continue;
      found.emplace_back(hamming_distance(w.descriptor, f.descriptors[k]), k);
    }
    if (found.empty()) continue;
    std::sort(found.begin(), found.end());
    if (found[0].first > options.max_distance) continue;
    if (options.best_to_second < 1 && found.size() > 1 &&
        f.octave[found[0].second] == f.octave[found[1].second] &&
        static_cast<float>(found[0].first) >
            options.best_to_second * static_cast<float>(found[1].first))
      continue;
    const std::pair claim{found[0].first, q};
    const auto [it, fresh] = owner.try_emplace(found[0].second, claim);
    if (!fresh) it->second = std::min(it->second, claim);
  }
  for (const auto& [k, claim] : owner) result[claim.second] = k;
  if (!options.check_rotation) return result;

  std::map<int, int> votes;
  const auto bin = [&](std::size_t q) {
    double turn = (queries[q].angle_rad - f.angle_rad[result[q]]) / (2 * M_PI);
    turn -= std::floor(turn);
    return std::min(29, static_cast<int>(turn * 30));
  };
  const auto voting = [&](std::size_t q) {
    return result[q] != kNoMatch && !std::isnan(queries[q].angle_rad);
  };
  for (std::size_t q = 0; q < queries.size(); ++q)
    if (voting(q)) ++votes[bin(q)];
  std::vector<std::pair<int, int>> order;
  for (const auto& [b, n] : votes) order.emplace_back(-n, b);
  std::sort(order.begin(), order.end());
  order.resize(std::min<std::size_t>(order.size(), 3));
  for (std::size_t q = 0; q < queries.size(); ++q)
    if (voting(q) &&
        std::none_of(order.begin(), order.end(), [&](const auto& o) { return o.second == bin(q); }))
      result[q] = kNoMatch;
  return result;
}

struct WindowScene {
  FeatureSet features;
  std::vector<WindowQuery> queries;
  std::vector<std::uint8_t> blocked;
};

WindowScene random_windows(unsigned seed) {
  std::mt19937 rng(seed);
  std::uniform_real_distribution<float> u(0, 1);
  WindowScene s;
  const int keypoints = static_cast<int>(rng() % 400), num_queries = static_cast<int>(rng() % 200);
  const float extent = seed % 4 == 0 ? 30.0f : 400.0f;  // every fourth: all in a few cells
  std::vector<Descriptor> looks;
  for (int i = 0; i < 50; ++i) looks.push_back(testing::random_descriptor(rng));
  for (int i = 0; i < keypoints; ++i)
    add_keypoint(s.features, extent * u(rng), extent * u(rng), static_cast<int>(rng() % 8),
                 testing::with_flipped_bits(looks[rng() % 50], static_cast<int>(rng() % 30), rng),
                 6.28f * u(rng), rng() % 2 ? extent * u(rng) : kNan);
  finish(s.features, testing::pinhole_rig().left);
  for (int i = 0; i < num_queries; ++i) {
    WindowQuery q;
    q.pixel = {extent * 1.1f * u(rng) - 10, extent * 1.1f * u(rng) - 10};
    q.right_x = rng() % 3 ? kNan : extent * u(rng);
    q.radius_px = 60 * u(rng);
    q.min_octave = static_cast<std::int16_t>(rng() % 6) - 1;
    q.max_octave = static_cast<std::int16_t>(q.min_octave + 3);
    q.descriptor = testing::with_flipped_bits(looks[rng() % 50], static_cast<int>(rng() % 40), rng);
    q.angle_rad = rng() % 5 ? 6.28f * u(rng) : kNan;
    s.queries.push_back(q);
  }
  if (seed % 3 == 0)
    for (int i = 0; i < keypoints; ++i) s.blocked.push_back(rng() % 4 == 0);
  return s;
}

TEST(WindowSearch, EqualsBruteForceWithBothExecutors) {
  int matched = 0;
  for (unsigned seed = 0; seed < 250; ++seed) {
    const WindowScene s = random_windows(seed);
    WindowSearchOptions options;
    options.check_rotation = seed % 2 == 0;
    options.best_to_second = seed % 5 == 0 ? 0.9f : 1;
    const auto expected = brute_force(s.features, s.queries, options, s.blocked);
    for (const Executor& executor : {Executor::reference(), Executor::cpu()})
      ASSERT_EQ(search_windows(executor, s.features, s.queries, options, s.blocked), expected)
          << seed;
    for (const int k : expected) matched += k != kNoMatch;
  }
  EXPECT_GT(matched, 1000);
}

TEST(WindowSearch, RightCoordinateGate) {
  FeatureSet f;
  add_keypoint(f, 100, 100, 0, {}, 0, 80);
  add_keypoint(f, 300, 100, 0, {});  // without a right coordinate
  finish(f, testing::pinhole_rig().left);
  WindowQuery q{{100, 100}, 85.1f, 5, 0, 0, {}, kNan};
  const auto search = [&] { return search_windows(Executor::cpu(), f, {&q, 1}, {})[0]; };
  EXPECT_EQ(search(), kNoMatch);
  q.right_x = 84.9f;
  EXPECT_EQ(search(), 0);
  q.right_x = kNan;
  EXPECT_EQ(search(), 0);
  q.pixel.x() = 300;
  q.right_x = 10;
  EXPECT_EQ(search(), 1);
}

TEST(WindowSearch, DropsMatchesThatTurnAgainstTheOthers) {
  std::mt19937 rng(5);
  FeatureSet f;
  std::vector<WindowQuery> queries;
  // 20 matches turn by 0.05 rad, one by 2.5; two more bins keep one match each (lower bins first).
  for (int i = 0; i < 23; ++i) {
    const Descriptor d = testing::random_descriptor(rng);
    const float turn = i < 20 ? 0.05f : i == 20 ? 2.5f : i == 21 ? 1.0f : 1.5f;
    add_keypoint(f, 20 * i + 5, 50, 0, d, 1.0f);
    queries.push_back({{20.0f * i + 5, 50}, kNan, 3, 0, 0, d, 1.0f + turn});
  }
  finish(f, testing::pinhole_rig().left);
  auto matches = search_windows(Executor::cpu(), f, queries, {});
  EXPECT_EQ(matches[20], kNoMatch);
  for (const int i : {0, 19, 21, 22}) EXPECT_EQ(matches[i], i);
  WindowSearchOptions any;
  any.check_rotation = false;
  EXPECT_EQ(search_windows(Executor::cpu(), f, queries, any)[20], 20);
  queries[20].angle_rad = kNan;
  EXPECT_EQ(search_windows(Executor::cpu(), f, queries, {})[20], 20);
}

TEST(WindowSearch, EmptyInputsAndBadMask) {
  FeatureSet none;
  finish(none, testing::pinhole_rig().left);
  const WindowQuery q{{10, 10}, kNan, 5, 0, 7, {}, 0};
  EXPECT_EQ(search_windows(Executor::cpu(), none, {&q, 1}, {}), std::vector{kNoMatch});
  EXPECT_TRUE(search_windows(Executor::cpu(), none, {}, {}).empty());
  const std::vector<std::uint8_t> mask(3);
  EXPECT_THROW(search_windows(Executor::cpu(), none, {&q, 1}, {}, mask), InvalidArgument);
}

TEST(RotationHistogram, BinsWrapAround) {
  EXPECT_EQ(RotationHistogram::bin(0), 0);
  EXPECT_EQ(RotationHistogram::bin(-1e-3f), 29);
  EXPECT_EQ(RotationHistogram::bin(static_cast<float>(2 * M_PI / 30) * 1.001f), 1);
  EXPECT_EQ(RotationHistogram::bin(static_cast<float>(2 * M_PI / 30) * 0.999f), 0);
  EXPECT_EQ(RotationHistogram::bin(static_cast<float>(4 * M_PI) + 0.01f), 0);
  for (float a = -20; a < 20; a += 0.001f) {
    EXPECT_GE(RotationHistogram::bin(a), 0);
    EXPECT_LT(RotationHistogram::bin(a), RotationHistogram::kBins);
  }
}

TEST(CameraView, FloatProjectionAgreesWithTheCamera) {
  std::mt19937 rng(9);
  std::uniform_real_distribution<double> u(-1, 1);
  Camera distorted = testing::pinhole_rig().left;
  distorted.distortion = {-0.28, 0.07, 2e-4, 1e-5, 0.01};
  for (const Camera& camera :
       {testing::pinhole_rig().left, distorted, testing::fisheye_rig().left}) {
    const CameraView view = make_camera_view(camera);
    int compared = 0;
    for (int i = 0; i < 5000; ++i) {
      const Vector3d p(u(rng), u(rng), u(rng) + 0.3);
      if (!camera.is_projectable(p) || !camera.contains(camera.project(p))) continue;
      const float pf[3] = {static_cast<float>(p.x()), static_cast<float>(p.y()),
                           static_cast<float>(p.z())};
      float x, y;
      ASSERT_TRUE(project(view, pf, &x, &y));
      EXPECT_LT((Eigen::Vector2d(x, y) - camera.project(p)).norm(), 1e-3);
      ++compared;
    }
    EXPECT_GT(compared, 200);
  }
}

TEST(CameraView, AxisAngleIsAtan2) {
  for (double a = 0; a <= M_PI; a += 1e-4) {
    const double r = std::sin(a), z = std::cos(a);
    EXPECT_NEAR(axis_angle(static_cast<float>(r), static_cast<float>(z)), a, 4e-7);
  }
  EXPECT_EQ(axis_angle(0, 0), 0);
}

TEST(CameraView, FisheyeStopsWhereItsModelFoldsBack) {
  Camera camera = testing::fisheye_rig().left;
  camera.distortion = {-0.1, 0, 0, 0, 0};  // slope 1 - 0.3 theta^2
  const CameraView view = make_camera_view(camera);
  const double fold = std::sqrt(1 / 0.3);
  EXPECT_NEAR(view.max_theta, fold, 2e-3);
  float x, y;
  for (const double off : {-0.01, 0.01}) {
    const float p[3] = {static_cast<float>(std::sin(fold + off)), 0,
                        static_cast<float>(std::cos(fold + off))};
    EXPECT_EQ(project(view, p, &x, &y), off < 0);
  }
}

}  // namespace
}  // namespace fastloop::matching
