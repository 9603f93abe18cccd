#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>
#include <nlohmann/json.hpp>
#include <random>

#include "fastloop/core/error.hpp"
#include "fastloop/eval/association.hpp"
#include "fastloop/eval/evaluation.hpp"

namespace fastloop::eval {
namespace {

using io::StampedPose;
using ::testing::ElementsAre;
using ::testing::IsEmpty;

const std::filesystem::path kTestdata = FASTLOOP_EVAL_TESTDATA;

std::vector<StampedPose> at_milliseconds(std::initializer_list<Nanoseconds> stamps_ms) {
  std::vector<StampedPose> poses;
  for (const Nanoseconds ms : stamps_ms) poses.push_back({ms * 1'000'000, SE3()});
  return poses;
}

SE3 random_pose(std::mt19937& random) {
  std::normal_distribution<double> n;
  return {Eigen::Quaterniond(n(random), n(random), n(random), n(random)),
          5 * Vector3d(n(random), n(random), n(random))};
}

TEST(Associate, TakesTheNearestWithinTheLimit) {
  const auto reference = at_milliseconds({0, 10, 20, 30, 40, 100, 500});
  EXPECT_THAT(associate(reference, at_milliseconds({-10, 14, 36, 111, 490})),
              ElementsAre(Match{0, 0}, Match{1, 1}, Match{4, 2}, Match{6, 4}));
  EXPECT_THAT(associate(reference, at_milliseconds({15})), ElementsAre(Match{1, 0}));
  EXPECT_THAT(associate(reference, at_milliseconds({1000})), IsEmpty());
  EXPECT_THAT(associate(reference, {}), IsEmpty());
  EXPECT_THAT(associate({}, reference), IsEmpty());
}

TEST(Associate, StartsFromTheTrajectoryWithFewerPoses) {
  EXPECT_THAT(associate(at_milliseconds({10, 20}), at_milliseconds({0, 9, 12, 19, 50})),
              ElementsAre(Match{0, 1}, Match{1, 3}));
}

TEST(Associate, AgreesWithBruteForce) {
  std::mt19937 random(3);
  std::uniform_int_distribution<Nanoseconds> step(1, 30'000'000);
  for (int round = 0; round < 20; ++round) {
    std::vector<StampedPose> a, b;
    for (Nanoseconds t = 0; a.size() < 200; t += step(random)) a.push_back({t, SE3()});
    for (Nanoseconds t = 0; b.size() < 150; t += step(random)) b.push_back({t, SE3()});
    std::vector<Match> expected;
    for (std::size_t j = 0; j < b.size(); ++j) {
      std::size_t best = 0;
      for (std::size_t i = 1; i < a.size(); ++i)
        if (std::abs(a[i].stamp_ns - b[j].stamp_ns) < std::abs(a[best].stamp_ns - b[j].stamp_ns))
          best = i;
      if (std::abs(a[best].stamp_ns - b[j].stamp_ns) <= kMaxTimeDifferenceNs)
        expected.push_back({best, j});
    }
    EXPECT_EQ(associate(a, b), expected);
  }
}

TEST(TimeCoverage, MissesWhatTheEstimateMisses) {
  std::vector<StampedPose> reference, whole, half;
  for (int i = 0; i < 1000; ++i) reference.push_back({i * 5'000'000LL, SE3()});
  for (int i = 0; i < 100; ++i) whole.push_back({i * 50'000'000LL, SE3()});
  half.assign(whole.begin(), whole.begin() + 50);
  EXPECT_DOUBLE_EQ(time_coverage(reference, whole), 1);
  EXPECT_NEAR(time_coverage(reference, half), 0.5, 0.01);
  EXPECT_DOUBLE_EQ(time_coverage(reference, {}), 0);
}

TEST(Align, RecoversAKnownSimilarity) {
  std::mt19937 random(5);
  for (int round = 0; round < 50; ++round) {
    const SE3 truth = random_pose(random);
    const double scale = 0.2 + round * 0.1;
    std::vector<Vector3d> from, rigid, similar;
    // Few points, half of the rounds in a plane: the case in which a reflection fits as well.
    for (int i = 0; i < 4; ++i) {
      Vector3d p = random_pose(random).translation;
      if (round % 2) p.z() = 0;
      from.push_back(p);
      rigid.push_back(truth * p);
      similar.push_back(truth * Vector3d(scale * p));
    }
    const Alignment se3 = align(from, rigid, AlignmentKind::kSe3);
    EXPECT_DOUBLE_EQ(se3.scale, 1);
    EXPECT_LT((se3.rotation - truth.rotation.toRotationMatrix()).norm(), 1e-9);
    EXPECT_LT((se3.translation - truth.translation).norm(), 1e-9);
    const Alignment sim3 = align(from, similar, AlignmentKind::kSim3);
    EXPECT_NEAR(sim3.scale, scale, 1e-9);
    EXPECT_LT((sim3.rotation - truth.rotation.toRotationMatrix()).norm(), 1e-9);
    EXPECT_LT((sim3 * from[2] - similar[2]).norm(), 1e-9);
  }
}

TEST(Align, RefusesWhatHasNoAnswer) {
  const std::vector<Vector3d> two(2, Vector3d::Ones());
  EXPECT_THROW(align(two, two, AlignmentKind::kSe3), InvalidArgument);
  const std::vector<Vector3d> line{{0, 0, 0}, {1, 2, 3}, {2, 4, 6}, {3, 6, 9}};
  EXPECT_THROW(align(line, line, AlignmentKind::kSim3), InvalidArgument);
  const std::vector<Vector3d> still(5, Vector3d::Zero());
  EXPECT_THROW(align(still, still, AlignmentKind::kSe3), InvalidArgument);
  EXPECT_THROW(align(line, two, AlignmentKind::kNone), InvalidArgument);
  EXPECT_NO_THROW(align(line, line, AlignmentKind::kNone));
}

TEST(Statistics, OfAKnownList) {
  const Statistics s = summarize_errors({4, 1, 3, 2});
  EXPECT_EQ(s.count, 4u);
  EXPECT_DOUBLE_EQ(s.mean, 2.5);
  EXPECT_DOUBLE_EQ(s.median, 2.5);
  EXPECT_DOUBLE_EQ(s.rmse, std::sqrt(7.5));
  EXPECT_DOUBLE_EQ(s.std, std::sqrt(1.25));
  EXPECT_DOUBLE_EQ(s.min, 1);
  EXPECT_DOUBLE_EQ(s.max, 4);
  EXPECT_EQ(summarize_errors({}).count, 0u);
}

TEST(PairsInTime, AtAConstantRateAreFramesApart) {
  std::vector<Nanoseconds> stamps;
  for (int i = 0; i < 10; ++i) stamps.push_back(i * 100'000'000LL);
  EXPECT_EQ(pairs_in_time(stamps, 300'000'000, RpePairs::kAll).size(), 7u);
  EXPECT_THAT(pairs_in_time(stamps, 300'000'000, RpePairs::kConsecutive),
              ElementsAre(IndexPair{0, 3}, IndexPair{3, 6}, IndexPair{6, 9}));
  EXPECT_THAT(pairs_in_time(stamps, 40'000'000, RpePairs::kAll), IsEmpty());
  EXPECT_THAT(pairs_in_time(stamps, 2'000'000'000, RpePairs::kAll), IsEmpty());
  EXPECT_THROW(pairs_in_time(stamps, 0, RpePairs::kAll), InvalidArgument);
}

TEST(PairsInTime, DoNotBridgeGaps) {
  std::vector<Nanoseconds> stamps;
  for (const int i : {0, 1, 2, 3, 20, 21, 22, 23}) stamps.push_back(i * 100'000'000LL);
  EXPECT_THAT(pairs_in_time(stamps, 200'000'000, RpePairs::kAll),
              ElementsAre(IndexPair{0, 2}, IndexPair{1, 3}, IndexPair{4, 6}, IndexPair{5, 7}));
  EXPECT_THAT(pairs_in_time(stamps, 200'000'000, RpePairs::kConsecutive),
              ElementsAre(IndexPair{0, 2}, IndexPair{4, 6}));
}

TEST(Evaluate, DoesNotDependOnTheWorldOfTheEstimate) {
  std::mt19937 random(9);
  std::vector<StampedPose> reference, estimate;
  const SE3 T_other_world = random_pose(random);
  for (int i = 0; i < 100; ++i) {
    reference.push_back({i * 50'000'000LL, random_pose(random)});
    estimate.push_back({i * 50'000'000LL, T_other_world * reference.back().T_world_x});
  }
  const Evaluation e = evaluate(reference, estimate, {AlignmentKind::kSe3, 0.5});
  EXPECT_LT(e.ate_m.max, 1e-9);
  EXPECT_LT(e.rpe->translation_m.max, 1e-9);
  EXPECT_LT(e.rpe->rotation_deg.max, 1e-5);
  EXPECT_LT(e.end_drift_percent, 1e-9);
  EXPECT_GT(evaluate(reference, estimate, {AlignmentKind::kNone, {}}).ate_m.rmse, 0.1);
  estimate.resize(2);
  EXPECT_THROW(evaluate(reference, estimate, {AlignmentKind::kSe3, {}}), InvalidArgument);
  for (auto& pose : estimate) pose.stamp_ns += 3'600'000'000'000;
  EXPECT_THROW(evaluate(reference, estimate, {AlignmentKind::kNone, {}}), InvalidArgument);
}

/// testdata/make_testdata.py made the two files and recorded what evo says about them.
class EvoOracle : public ::testing::TestWithParam<std::pair<AlignmentKind, std::string>> {
 protected:
  static void expect_equal(const Statistics& ours, const nlohmann::json& evo) {
    EXPECT_NEAR(ours.rmse, evo.at("rmse").get<double>(), 1e-6);
    EXPECT_NEAR(ours.mean, evo.at("mean").get<double>(), 1e-6);
    EXPECT_NEAR(ours.median, evo.at("median").get<double>(), 1e-6);
    EXPECT_NEAR(ours.std, evo.at("std").get<double>(), 1e-6);
    EXPECT_NEAR(ours.min, evo.at("min").get<double>(), 1e-6);
    EXPECT_NEAR(ours.max, evo.at("max").get<double>(), 1e-6);
  }
};

TEST_P(EvoOracle, AgreesToAMillionth) {
  const auto& [kind, name] = GetParam();
  const auto evo = nlohmann::json::parse(std::ifstream(kTestdata / "evo_numbers.json"));
  const auto reference = io::read_trajectory(kTestdata / "groundtruth.csv");
  const auto estimate = io::read_trajectory(kTestdata / "estimate.txt");
  for (const int frames : {1, 20}) {
    const Evaluation e = evaluate(reference.poses, estimate.poses, {kind, frames * 0.05});
    EXPECT_EQ(e.errors_m.size(), evo.at("matched").get<std::size_t>());
    EXPECT_NEAR(e.path_length_m, evo.at("path_length_m").get<double>(), 1e-6);
    expect_equal(e.ate_m, evo.at("ape_" + name));
    const std::string rpe = "rpe_" + name + "_" + std::to_string(frames);
    expect_equal(e.rpe->translation_m, evo.at(rpe + "_all_translation_part"));
    expect_equal(e.rpe->rotation_deg, evo.at(rpe + "_all_rotation_angle_deg"));
    expect_equal(e.rpe->consecutive_translation_m, evo.at(rpe + "_consecutive_translation_part"));
    expect_equal(e.rpe->consecutive_rotation_deg, evo.at(rpe + "_consecutive_rotation_angle_deg"));
  }
}

INSTANTIATE_TEST_SUITE_P(Alignments, EvoOracle,
                         ::testing::Values(std::pair{AlignmentKind::kNone, "none"},
                                           std::pair{AlignmentKind::kSe3, "se3"},
                                           std::pair{AlignmentKind::kSim3, "sim3"}),
                         [](const auto& param) { return param.param.second; });

}  // namespace
}  // namespace fastloop::eval
