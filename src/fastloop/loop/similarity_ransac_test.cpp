#include "fastloop/loop/similarity_ransac.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <random>

#include "fastloop/compute/executors_for_tests.hpp"
#include "fastloop/matching/scene_for_tests.hpp"

/// The executors against each other and against a plain loop written from the header's text.
namespace fastloop::loop {
namespace {

using matching::CameraView;

struct ProblemOptions {
  int pairs = 60;
  double outliers = 0.3;  ///< share of pairs that show different points
  double noise_px = 0.3;
  int views = 2;
  double scale = 1;
  double behind = 0;  ///< share of points behind the first camera
  bool flat = false;  ///< all points on one line: no sample defines a similarity
  int copies = 1;     ///< of every pair: samples that hold one twice are degenerate, counts tie
};

struct Problem {
  SimilarityPairs pairs;
  Sim3 truth;
};

void push(std::vector<float>& to, const auto& v) {
  for (Eigen::Index i = 0; i < v.size(); ++i) to.push_back(static_cast<float>(v[i]));
}

Problem random_problem(const Camera& camera, const ProblemOptions& o, std::mt19937& rng) {
  std::uniform_real_distribution<double> u(-1, 1);
  const auto vector = [&] { return Vector3d(u(rng), u(rng), u(rng)); };
  Problem p;
  p.truth = Sim3(so3::exp(2 * vector()), 3 * vector(), o.scale);
  std::vector<SE3> T_view_second;
  for (int v = 0; v < o.views; ++v) {
    // Cameras of the second side stand near the place that the first one sees.
    const SE3 near_first(so3::exp(0.1 * vector()), 0.3 * vector());
    const Sim3 T = Sim3(near_first) * p.truth;
    T_view_second.emplace_back(T.rotation, Vector3d(T.translation / T.scale));
    ViewPose pose;
    const Matrix3d r = T.rotation.toRotationMatrix();
    for (int i = 0; i < 9; ++i) pose.rotation[i] = static_cast<float>(r(i / 3, i % 3));
    for (int i = 0; i < 3; ++i)
      pose.translation[i] = static_cast<float>(T_view_second.back().translation[i]);
    p.pairs.views.push_back(pose);
  }
  const auto pixel_of = [&](const Vector3d& at) -> Eigen::Vector2d {
    const Eigen::Vector2d noise(o.noise_px * u(rng), o.noise_px * u(rng));
    return camera.is_projectable(at) ? Eigen::Vector2d(camera.project(at) + noise) : noise;
  };
  for (int i = 0; i < o.pairs; ++i) {
    Vector3d first(2 * u(rng), 1.5 * u(rng), 5 + 2 * u(rng));
    if (o.flat) first = Vector3d(0.1, 0.2, 4) + u(rng) * Vector3d(1, 0.3, 0.5);
    if (u(rng) < 2 * o.behind - 1) first.z() = -first.z();
    Vector3d second = p.truth.inverse() * first;
    if (u(rng) < 2 * o.outliers - 1) second += 2 * vector();
    const auto view = static_cast<std::int32_t>(rng() % static_cast<unsigned>(o.views));
    const Eigen::Vector2d pixel = pixel_of(first), seen = pixel_of(T_view_second[view] * second);
    const float sigma2 = std::pow(1.44f, static_cast<float>(rng() % 4));
    for (int copy = 0; copy < o.copies; ++copy) {
      push(p.pairs.p_first, first);
      push(p.pairs.pixel_first, pixel);
      p.pairs.gate_first.push_back(9.21f * sigma2);
      push(p.pairs.p_second, second);
      p.pairs.view.push_back(view);
      push(p.pairs.pixel_view, seen);
      p.pairs.gate_view.push_back(9.21f * sigma2);
    }
  }
  return p;
}

PairArrays arrays_of(const SimilarityPairs& p) {
  return {p.p_first.data(),   p.pixel_first.data(), p.gate_first.data(),
          p.p_second.data(),  p.view.data(),        p.pixel_view.data(),
          p.gate_view.data(), p.views.data(),       static_cast<int>(p.size())};
}

int number_of_hypotheses(std::size_t pairs, const RansacOptions& o) {
  if (pairs < 3 || static_cast<int>(pairs) <= o.min_inliers) return 0;
  const double good = std::pow(static_cast<double>(o.min_inliers) / static_cast<double>(pairs), 3);
  const double needed = std::ceil(std::log(1 - o.confidence) / std::log(1 - good));
  return static_cast<int>(std::min<double>(o.max_hypotheses, std::max(1.0, needed)));
}

/// One problem, one hypothesis after another.
RansacResult one_by_one(const CameraView& camera, const SimilarityPairs& p,
                        const RansacOptions& o) {
  RansacResult result;
  const PairArrays pairs = arrays_of(p);
  const int total = number_of_hypotheses(p.size(), o);
  for (int h = 0; h < total; ++h) {
    SimilarityF s;
    int count = 0;
    if (make_hypothesis(pairs, o.seed, h, o.fixed_scale, &s))
      for (int i = 0; i < pairs.size; ++i) count += is_inlier(camera, pairs, s, i);
    if (count > result.num_inliers) {
      result.num_inliers = count;
      result.hypothesis = h;
    }
    result.evaluated = h + 1;
    if ((h + 1) % o.chunk == 0 && result.num_inliers > o.min_inliers) break;
  }
  result.found = result.num_inliers > o.min_inliers;
  if (!result.found) {
    result.hypothesis = -1;
    return result;
  }
  SimilarityF s;
  make_hypothesis(pairs, o.seed, result.hypothesis, o.fixed_scale, &s);
  for (int i = 0; i < pairs.size; ++i) result.inlier.push_back(is_inlier(camera, pairs, s, i));
  return result;
}

/// All integers, and the similarity bit for bit.
void expect_equal(const RansacResult& a, const RansacResult& b) {
  EXPECT_EQ(a.found, b.found);
  EXPECT_EQ(a.hypothesis, b.hypothesis);
  EXPECT_EQ(a.num_inliers, b.num_inliers);
  EXPECT_EQ(a.evaluated, b.evaluated);
  EXPECT_EQ(a.inlier, b.inlier);
}

void expect_same_bits(const Sim3& a, const Sim3& b) {
  const auto bits = [](const Sim3& s) {
    std::array<double, 8> v{s.rotation.w(),    s.rotation.x(),    s.rotation.y(),    s.rotation.z(),
                            s.translation.x(), s.translation.y(), s.translation.z(), s.scale};
    std::array<std::uint64_t, 8> out;
    std::memcpy(out.data(), v.data(), sizeof out);
    return out;
  };
  EXPECT_EQ(bits(a), bits(b));
}

/// The parallel executors, and one that goes to the device after the first chunk.
std::vector<StepExecutors> with_choosing() {
  std::vector<StepExecutors> all;
  for (const Executor& e : fastloop::testing::parallel_executors()) all.emplace_back(e);
  CostModel costs = CostModel::defaults(1);
  costs.of(Step::kSimilarity) = {{0, 1}, {1e-3 * 2000, 0}};  // from 2,400 pairs x hypotheses on
  all.emplace_back(Executor::cpu(), fastloop::testing::parallel_executors().back(), costs);
  return all;
}

ProblemOptions situation(unsigned seed, std::mt19937& rng) {
  ProblemOptions o;
  static constexpr int kSizes[] = {0, 1, 2, 3, 4, 15, 16, 17, 40, 120};
  o.pairs = kSizes[rng() % 10];
  o.outliers = 0.1 * static_cast<double>(rng() % 11);
  o.noise_px = seed % 3 == 0 ? 0 : 2;
  o.views = 1 + static_cast<int>(rng() % 5);
  o.scale = seed % 4 == 0 ? 1.3 : 1;
  o.behind = seed % 7 == 0 ? 0.5 : 0;
  o.flat = seed % 11 == 0;
  o.copies = seed % 5 == 0 ? 3 : 1;
  return o;
}

TEST(SimilarityRansac, AllExecutorsEqualOneByOne) {
  int situations = 0, found = 0, refused = 0, decided_late = 0;
  for (unsigned seed = 0; seed < 240; ++seed) {
    std::mt19937 rng(seed);
    const Camera camera =
        (seed % 2 ? matching::testing::fisheye_rig() : matching::testing::pinhole_rig()).left;
    const CameraView view = matching::make_camera_view(camera);
    std::vector<SimilarityPairs> problems;
    for (unsigned i = 0; i < rng() % 5; ++i)  // none at all, too
      problems.push_back(random_problem(camera, situation(seed, rng), rng).pairs);
    RansacOptions o;
    o.seed = seed;
    o.fixed_scale = seed % 4 != 0;
    o.min_inliers = seed % 6 == 0 ? 3 : 15;
    o.chunk = seed % 5 == 0 ? 7 : 20;
    std::vector<RansacResult> reference(problems.size());
    find_similarities(Executor::reference(), view, problems, o, reference);
    std::vector<std::vector<RansacResult>> others;
    for (const StepExecutors& executors : with_choosing()) {
      others.emplace_back(problems.size());
      find_similarities(executors, view, problems, o, others.back());
    }
    for (std::size_t p = 0; p < problems.size(); ++p) {
      SCOPED_TRACE(::testing::Message() << "seed " << seed << " problem " << p);
      expect_equal(reference[p], one_by_one(view, problems[p], o));
      for (const auto& other : others) {
        expect_equal(reference[p], other[p]);
        expect_same_bits(reference[p].S_first_second, other[p].S_first_second);
      }
      ++situations;
      ++(reference[p].found ? found : refused);
      decided_late += reference[p].found && reference[p].evaluated > o.chunk;
    }
  }
  EXPECT_GE(situations, 200);
  EXPECT_GT(found, 60);
  EXPECT_GT(refused, 60);
  EXPECT_GT(decided_late, 3);
}

TEST(SimilarityRansacOnDevice, WhatFailsThereIsDoneOnTheCpu) {
  const auto session = CudaSession::open();
  if (!session) GTEST_SKIP() << "no CUDA device";
  std::mt19937 rng(3);
  const Camera camera = matching::testing::pinhole_rig().left;
  const CameraView view = matching::make_camera_view(camera);
  std::vector<SimilarityPairs> problems;
  for (int i = 0; i < 4; ++i) problems.push_back(random_problem(camera, {}, rng).pairs);
  const RansacOptions o;
  std::vector<RansacResult> reference(problems.size());
  find_similarities(Executor::reference(), view, problems, o, reference);
  for (const bool lost : {false, true})
    for (int call = 1; call < 8; ++call) {
      const auto fresh = CudaSession::open();
      fresh->inject_failure(call, lost);
      std::vector<RansacResult> other(problems.size());
      find_similarities(Executor::cuda(fresh), view, problems, o, other);
      for (std::size_t p = 0; p < problems.size(); ++p) expect_equal(reference[p], other[p]);
    }
}

TEST(SimilarityRansacOnDevice, OneLaunchAndOneWaitForAllProblems) {
  const auto session = CudaSession::open();
  if (!session) GTEST_SKIP() << "no CUDA device";
  std::mt19937 rng(4);
  const Camera camera = matching::testing::pinhole_rig().left;
  const CameraView view = matching::make_camera_view(camera);
  std::vector<SimilarityPairs> problems;
  for (int i = 0; i < 6; ++i) problems.push_back(random_problem(camera, {}, rng).pairs);
  std::vector<RansacResult> results(problems.size());
  find_similarities(Executor::cuda(session), view, problems, {}, results);
  const CudaCounters before = session->counters();
  find_similarities(Executor::cuda(session), view, problems, {}, results);
  const CudaCounters after = session->counters();
  EXPECT_EQ(after.launches - before.launches, 1u);
  EXPECT_EQ(after.synchronizations - before.synchronizations, 1u);
  EXPECT_EQ(after.allocations, before.allocations);
}

TEST(SimilarityRansac, FindsTheTruthAmongOutliers) {
  for (unsigned seed = 0; seed < 40; ++seed) {
    std::mt19937 rng(seed);
    const Camera camera =
        (seed % 2 ? matching::testing::fisheye_rig() : matching::testing::pinhole_rig()).left;
    ProblemOptions o;
    o.outliers = 0.4;
    o.noise_px = 0;
    o.scale = seed % 4 ? 1 : 1.2;
    const Problem problem = random_problem(camera, o, rng);
    RansacOptions options;
    options.seed = seed;
    options.fixed_scale = seed % 4;
    RansacResult r;
    find_similarities(Executor::cpu(), matching::make_camera_view(camera), {&problem.pairs, 1},
                      options, {&r, 1});
    ASSERT_TRUE(r.found) << seed;
    EXPECT_GE(r.num_inliers, 25);
    EXPECT_NEAR(r.S_first_second.scale, problem.truth.scale, 1e-3);
    EXPECT_LT(angle_between(r.S_first_second.rigid(), problem.truth.rigid()), 1e-3);
    EXPECT_LT((r.S_first_second.translation - problem.truth.translation).norm(), 1e-2);
  }
}

/// 20 exact pairs and 10 that show different points.
class RansacThresholds : public ::testing::Test {
 protected:
  RansacThresholds() {
    std::mt19937 rng(5);
    ProblemOptions exact, wrong;
    exact.pairs = kGood;
    exact.outliers = exact.noise_px = 0;
    exact.views = 1;
    pairs_ = random_problem(camera_, exact, rng).pairs;
    wrong = exact;
    wrong.pairs = 10;
    wrong.outliers = 1;
    const SimilarityPairs bad = random_problem(camera_, wrong, rng).pairs;
    const auto append = [](auto& to, const auto& from) {
      to.insert(to.end(), from.begin(), from.end());
    };
    append(pairs_.p_first, bad.p_first);
    append(pairs_.pixel_first, bad.pixel_first);
    append(pairs_.gate_first, bad.gate_first);
    append(pairs_.p_second, bad.p_second);
    append(pairs_.view, bad.view);
    append(pairs_.pixel_view, bad.pixel_view);
    append(pairs_.gate_view, bad.gate_view);
  }
  RansacResult run() const {
    RansacResult reference;
    find_similarities(Executor::reference(), view_, {&pairs_, 1}, options_, {&reference, 1});
    for (const StepExecutors& executors : with_choosing()) {
      RansacResult other;
      find_similarities(executors, view_, {&pairs_, 1}, options_, {&other, 1});
      expect_equal(reference, other);
    }
    return reference;
  }

  static constexpr int kGood = 20;
  const Camera camera_ = matching::testing::pinhole_rig().left;
  const CameraView view_ = matching::make_camera_view(camera_);
  SimilarityPairs pairs_;
  RansacOptions options_;
};

TEST_F(RansacThresholds, MoreThanMinInliersAccept) {
  options_.min_inliers = kGood - 1;
  EXPECT_TRUE(run().found);
  options_.min_inliers = kGood;
  EXPECT_FALSE(run().found);
  EXPECT_EQ(run().num_inliers, kGood);
  EXPECT_EQ(run().hypothesis, -1);
  EXPECT_TRUE(run().inlier.empty());
}

TEST_F(RansacThresholds, GateOfEitherImage) {
  for (std::vector<float>* pixels : {&pairs_.pixel_first, &pairs_.pixel_view})
    for (const double off : {-0.02, 0.02}) {
      const float before = (*pixels)[7];  // row of the fourth pair
      const bool first = pixels == &pairs_.pixel_first;
      const double gate = first ? pairs_.gate_first[3] : pairs_.gate_view[3];
      (*pixels)[7] += static_cast<float>(std::sqrt(gate) + off);
      const RansacResult r = run();
      ASSERT_TRUE(r.found);
      EXPECT_EQ(r.inlier[3] != 0, off < 0);
      EXPECT_EQ(r.num_inliers, kGood - (off > 0));
      (*pixels)[7] = before;
    }
}

TEST_F(RansacThresholds, HypothesesFollowFromTheShareOfInliersAskedFor) {
  // None can have as many inliers as asked for: all hypotheses are looked at.
  options_.min_inliers = kGood;
  EXPECT_EQ(run().evaluated, number_of_hypotheses(pairs_.size(), options_));
  EXPECT_GT(run().evaluated, 5);
  options_.max_hypotheses = run().evaluated - 1;
  EXPECT_EQ(run().evaluated, options_.max_hypotheses);
  options_.min_inliers = static_cast<int>(pairs_.size()) - 1;
  EXPECT_GT(run().evaluated, 0);
  options_.min_inliers = static_cast<int>(pairs_.size());
  EXPECT_EQ(run().evaluated, 0);
}

TEST_F(RansacThresholds, TheFirstChunkThatHoldsOneDecides) {
  options_.chunk = 1;
  const RansacResult r = run();
  ASSERT_TRUE(r.found);
  EXPECT_EQ(r.evaluated, r.hypothesis + 1);
  options_.chunk = r.evaluated + 1;
  EXPECT_EQ(run().evaluated,
            std::min(options_.chunk, number_of_hypotheses(pairs_.size(), options_)));
  EXPECT_GE(run().num_inliers, r.num_inliers);
}

TEST(SimilaritySample, IsThreeDifferentIndices) {
  for (int n = 3; n < 12; ++n) {
    std::vector<int> drawn(static_cast<std::size_t>(n), 0);
    for (int h = 0; h < 400; ++h) {
      int pick[3];
      sample_three(9, h, n, pick);
      for (const int i : pick) {
        ASSERT_GE(i, 0);
        ASSERT_LT(i, n);
        ++drawn[static_cast<std::size_t>(i)];
      }
      EXPECT_TRUE(pick[0] != pick[1] && pick[1] != pick[2] && pick[0] != pick[2]);
    }
    // Each index about equally often: 1200 / n, four standard deviations.
    for (const int times : drawn) EXPECT_NEAR(times, 1200.0 / n, 4 * std::sqrt(1200.0 / n));
  }
}

}  // namespace
}  // namespace fastloop::loop
