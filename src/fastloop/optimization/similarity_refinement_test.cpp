#include "fastloop/optimization/similarity_refinement.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstring>
#include <random>

#include "fastloop/matching/scene_for_tests.hpp"

/// Both ways of refining against each other, against the truth and against their definition written
/// as brute force.
namespace fastloop::optimization {
namespace {

struct Situation {
  Camera camera;
  Sim3 truth, initial;
  SimilarityOptions options;
  std::vector<SimilarityPair> pairs;
};

Vector3d random_vector(std::mt19937& rng) {
  std::uniform_real_distribution<double> u(-1, 1);
  const double x = u(rng), y = u(rng), z = u(rng);
  return {x, y, z};
}

SimilarityPair exact_pair(const Situation& s, std::mt19937& rng) {
  SimilarityPair p;
  const Vector3d r = random_vector(rng);
  p.p_first = Vector3d(2 * r.x(), 1.5 * r.y(), 5 + 2 * r.z());
  p.p_second = s.truth.inverse() * p.p_first;
  const Vector3d turn = 0.1 * random_vector(rng), shift = 0.3 * random_vector(rng);
  const Sim3 view = Sim3(SE3(so3::exp(turn), shift)) * s.truth;
  p.T_view_second = SE3(view.rotation, Vector3d(view.translation / view.scale));
  p.pixel_first = s.camera.project(p.p_first);
  p.pixel_view = s.camera.project(p.T_view_second * p.p_second);
  return p;
}

Situation situation(unsigned seed, int pairs, double noise_px) {
  std::mt19937 rng(seed);
  std::normal_distribution<double> n(0, 1);
  Situation s;
  s.camera = (seed % 2 ? matching::testing::fisheye_rig() : matching::testing::pinhole_rig()).left;
  s.options.fixed_scale = seed % 3 != 0;
  const double scale = s.options.fixed_scale ? 1 : 1.2;
  s.truth = Sim3(so3::exp(2 * random_vector(rng)), 3 * random_vector(rng), scale);
  Vector7d off;
  for (int i = 0; i < 7; ++i) off[i] = 0.01 * n(rng);
  if (s.options.fixed_scale) off[6] = 0;
  s.initial = Sim3::exp(off) * s.truth;
  for (int i = 0; i < pairs; ++i) {
    SimilarityPair p = exact_pair(s, rng);
    const double sigma = std::pow(1.2, static_cast<double>(rng() % 4));
    p.inv_sigma2_first = p.inv_sigma2_view = 1 / (sigma * sigma);
    for (Eigen::Vector2d* pixel : {&p.pixel_first, &p.pixel_view})
      for (int k = 0; k < 2; ++k) (*pixel)[k] += noise_px * sigma * n(rng);
    s.pairs.push_back(p);
  }
  return s;
}

/// Squared normalised errors of a pair in both images.
std::pair<double, double> errors(const Situation& s, const Sim3& S, const SimilarityPair& p) {
  const auto error = [&](const Vector3d& at, const Eigen::Vector2d& pixel, double weight) {
    return s.camera.is_projectable(at) ? weight * (s.camera.project(at) - pixel).squaredNorm()
                                       : std::numeric_limits<double>::infinity();
  };
  return {error(S * p.p_second, p.pixel_first, p.inv_sigma2_first),
          error(p.T_view_second * (S.inverse() * p.p_first), p.pixel_view, p.inv_sigma2_view)};
}

double cost(const Situation& s, const Sim3& S) {
  double sum = 0;
  for (const SimilarityPair& p : s.pairs) sum += errors(s, S, p).first + errors(s, S, p).second;
  return sum;
}

SimilarityResult refine(const Situation& s) {
  return refine_similarity(s.camera, s.initial, s.pairs, s.options);
}

double distance(const Sim3& a, const Sim3& b) {
  return (a.inverse() * b).log().norm();
}

TEST(SimilarityRefinement, EndsAtTheMinimumOfItsCost) {
  int complete = 0;
  for (unsigned seed = 0; seed < 240; ++seed) {
    Situation s = situation(seed, 12 + static_cast<int>(seed % 60), 0.5);
    const SimilarityResult r = refine(s);
    // Only where no pair was dropped the cost is known here: all of them.
    if (r.num_inliers < static_cast<int>(s.pairs.size())) continue;
    ++complete;
    const double here = cost(s, r.S_first_second);
    for (int axis = 0; axis < (s.options.fixed_scale ? 6 : 7); ++axis) {
      // Slope and curvature by differences: the distance to the minimum along each axis.
      constexpr double kStep = 1e-4;
      const Vector7d d = kStep * Vector7d::Unit(axis);
      const double plus = cost(s, Sim3::exp(d) * r.S_first_second),
                   minus = cost(s, Sim3::exp(-d) * r.S_first_second);
      EXPECT_GT(plus, here) << seed << " " << axis;
      EXPECT_GT(minus, here) << seed << " " << axis;
      const double slope = (plus - minus) / (2 * kStep),
                   curvature = (plus + minus - 2 * here) / (kStep * kStep);
      EXPECT_LT(std::abs(slope / curvature), 1e-6) << seed << " " << axis;
    }
    if (s.options.fixed_scale) {
      EXPECT_EQ(r.S_first_second.scale, s.initial.scale);
    }
  }
  EXPECT_GE(complete, 200);
}

TEST(SimilarityRefinement, FindsTheTruthAmongOutliersAndNamesThem) {
  int all_named = 0;
  for (unsigned seed = 0; seed < 200; ++seed) {
    Situation s = situation(seed, 40, 0);
    std::mt19937 rng(seed);
    std::vector<std::uint8_t> good(s.pairs.size(), 1);
    for (std::size_t i = 0; i < s.pairs.size(); ++i) {
      if (rng() % 8 != 0) continue;
      good[i] = 0;
      SimilarityPair& p = s.pairs[i];
      if (i % 3 == 0) p.p_second = s.truth.inverse() * -p.p_first;  // behind the camera
      if (i % 3 == 1) p.pixel_first += Eigen::Vector2d(20, -15);
      if (i % 3 == 2) p.pixel_view += Eigen::Vector2d(-20, 15);
    }
    const SimilarityResult r = refine(s);
    all_named += r.inlier == good;
    EXPECT_EQ(r.num_inliers, std::count(r.inlier.begin(), r.inlier.end(), 1));
    EXPECT_LT(distance(r.S_first_second, s.truth), 1e-7) << seed;
    for (std::size_t i = 0; i < s.pairs.size(); ++i) {
      const auto [first, view] = errors(s, r.S_first_second, s.pairs[i]);
      const bool within = first <= s.options.chi2_gate && view <= s.options.chi2_gate;
      EXPECT_EQ(within, good[i] != 0);
      // A pair dropped half way does not come back, as published; none beyond the gate is left.
      EXPECT_LE(r.inlier[i] != 0, within);
    }
  }
  EXPECT_GT(all_named, 180);
}

TEST(SimilarityRefinement, ReferenceAgrees) {
  double most = 0;
  int dropped = 0;
  for (unsigned seed = 0; seed < 300; ++seed) {
    Situation s = situation(seed, 8 + static_cast<int>(seed % 90), 0.7);
    std::mt19937 rng(seed);
    for (SimilarityPair& p : s.pairs)
      if (rng() % 12 == 0) p.pixel_first += Eigen::Vector2d(25, -10);
    const SimilarityResult a = refine(s),
                           b = refine_similarity_reference(s.camera, s.initial, s.pairs, s.options);
    EXPECT_EQ(a.num_inliers, b.num_inliers) << seed;
    EXPECT_EQ(a.inlier, b.inlier) << seed;
    most = std::max(most, distance(a.S_first_second, b.S_first_second));
    dropped += a.num_inliers < static_cast<int>(s.pairs.size());
  }
  EXPECT_LT(most, 1e-9);  // far below what moves a projection in floats by a bit
  EXPECT_GT(dropped, 100);
}

TEST(SimilarityRefinement, SameBitsTwice) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    const Situation s = situation(seed, 60, 2);
    const SimilarityResult a = refine(s), b = refine(s);
    EXPECT_EQ(a.inlier, b.inlier);
    EXPECT_EQ(a.num_inliers, b.num_inliers);
    EXPECT_EQ(a.S_first_second.rotation.coeffs(), b.S_first_second.rotation.coeffs());
    EXPECT_EQ(a.S_first_second.translation, b.S_first_second.translation);
    EXPECT_EQ(a.S_first_second.scale, b.S_first_second.scale);
  }
}

TEST(SimilarityRefinement, GateOnEitherSide) {
  for (const bool in_first : {false, true})
    for (const double share : {0.99, 1.01}) {
      Situation s = situation(7, 40, 0);
      SimilarityPair& p = s.pairs[5];
      // So little weight that the pair moves nothing, and an error to match.
      (in_first ? p.inv_sigma2_first : p.inv_sigma2_view) = 1e-6;
      (in_first ? p.pixel_first : p.pixel_view).x() +=
          std::sqrt(share * s.options.chi2_gate / 1e-6);
      const SimilarityResult r = refine(s);
      EXPECT_EQ(r.inlier[5] != 0, share < 1);
      EXPECT_EQ(r.num_inliers, 40 - (share > 1));
    }
}

TEST(SimilarityRefinement, AsManyPairsAsAskedFor) {
  for (const unsigned seed : {2u, 3u}) {
    EXPECT_EQ(refine(situation(seed, 10, 0)).num_inliers, 10);
    const Situation few = situation(seed, 9, 0);
    const SimilarityResult r = refine(few);
    EXPECT_EQ(r.num_inliers, 0);
    EXPECT_EQ(r.inlier, std::vector<std::uint8_t>(9, 0));
    EXPECT_EQ(distance(r.S_first_second, few.initial), 0);
    // Enough pairs, but one too few that agree.
    Situation s = situation(seed, 11, 0);
    s.pairs[0].pixel_first.x() += 300;
    EXPECT_EQ(refine(s).num_inliers, 10);
    s.pairs[1].pixel_view.x() += 300;
    EXPECT_EQ(refine(s).num_inliers, 0);
    EXPECT_EQ(refine(situation(seed, 0, 0)).num_inliers, 0);
  }
}

TEST(SimilarityRefinement, NothingToSeeOrNotFinite) {
  Situation s = situation(4, 30, 0);
  s.initial.translation.x() = NAN;
  EXPECT_EQ(refine(s).num_inliers, 0);
  s = situation(4, 30, 0);
  for (SimilarityPair& p : s.pairs) p.p_second = s.truth.inverse() * -p.p_first;
  EXPECT_EQ(refine(s).num_inliers, 0);
}

}  // namespace
}  // namespace fastloop::optimization
