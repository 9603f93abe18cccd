#include "fastloop/optimization/inertial_init.hpp"

#include <gtest/gtest.h>

#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/synthetic_for_tests.hpp"
#include "fastloop/sensor/motion_for_tests.hpp"

namespace fastloop::optimization {
namespace {

using namespace synthetic;
using fastloop::synthetic::disturb;
using fastloop::synthetic::Motion;
using fastloop::synthetic::regular_samples;

const ImuBias kTrueBias{{0.02, -0.015, 0.01}, {0.05, 0.03, -0.06}};
/// A visual world that is not aligned with gravity.
const SE3 kVisualFromTrue(so3::exp({1.2, -0.7, 0.4}), Vector3d(3, -2, 1));

struct Case {
  InertialInitProblem problem;
  std::vector<Vector3d> v_true;  ///< in the visual world
};

struct CaseOptions {
  int keyframes = 20;
  Nanoseconds step_ns = 250'000'000;
  double position_noise = 0, rotation_noise = 0;
  double visual_scale = 1;  ///< size of the visual world over that of the true one
  bool imu_noise = true;
};

Case make_case(const CaseOptions& o, unsigned seed) {
  std::mt19937 rng(seed);
  ImuCalibration noise;
  if (!o.imu_noise) noise.gyro_noise_density = noise.accel_noise_density = 1e-9;
  const Nanoseconds begin = static_cast<Nanoseconds>(seed % 10) * 300'000'000;
  auto samples = regular_samples(begin, begin + o.keyframes * o.step_ns, 5'000'000);
  disturb(samples, kTrueBias, noise, rng);
  Case c;
  for (int i = 0; i < o.keyframes; ++i) {
    const NavState truth = Motion::state(begin + i * o.step_ns);
    SE3 T = kVisualFromTrue * truth.T_world_body;
    T = T *
        SE3(so3::exp(normal_vector(rng, o.rotation_noise)), normal_vector(rng, o.position_noise));
    T.translation *= o.visual_scale;
    c.problem.T_world_body.push_back(T);
    c.v_true.push_back(kVisualFromTrue.rotation * truth.v_world);
    if (i + 1 < o.keyframes)
      c.problem.between.push_back(std::make_shared<PreintegratedImu>(samples, begin + i * o.step_ns,
                                                                     begin + (i + 1) * o.step_ns,
                                                                     ImuBias{}, ImuCalibration{}));
  }
  return c;
}

double gravity_error(const InertialInitResult& r) {
  const Vector3d truth = kVisualFromTrue.rotation * kGravityWorld;
  const Vector3d found = r.R_world_gravity * kGravityWorld;
  return std::atan2(truth.cross(found).norm(), truth.dot(found));
}

TEST(InertialInit, FindsEverythingWithoutNoise) {
  Case c = make_case({.imu_noise = false}, 1);
  c.problem.accel_prior_information = c.problem.gyro_prior_information = 1e-6;
  const InertialInitResult r = initialize_inertial(c.problem);
  ASSERT_TRUE(r.success) << r.reason;
  EXPECT_LT(gravity_error(r), 1e-4);
  EXPECT_LT((r.bias.gyro - kTrueBias.gyro).norm(), 1e-4);
  EXPECT_LT((r.bias.accel - kTrueBias.accel).norm(), 1e-3);
  EXPECT_EQ(r.scale, 1);
  for (std::size_t i = 0; i < c.v_true.size(); ++i)
    EXPECT_LT((r.v_world[i] - c.v_true[i]).norm(), 1e-3);
}

TEST(InertialInit, FindsTheScale) {
  for (const double visual_scale : {0.2, 1.0, 3.0}) {
    Case c = make_case({.visual_scale = visual_scale, .imu_noise = false}, 2);
    c.problem.estimate_scale = true;
    c.problem.accel_prior_information = 1e-3;
    const InertialInitResult r = initialize_inertial(c.problem);
    ASSERT_TRUE(r.success) << r.reason;
    EXPECT_NEAR(r.scale * visual_scale, 1.0, 2e-3);
    EXPECT_LT(gravity_error(r), 1e-3);
  }
}

TEST(InertialInit, ErrorAgreesWithItsStandardDeviation) {
  double ratio2 = 0, worst = 0;
  const int trials = 60;
  for (int i = 0; i < trials; ++i) {
    Case c = make_case({.position_noise = 2e-3, .rotation_noise = 5e-4}, 100 + i);
    const InertialInitResult r = initialize_inertial(c.problem);
    ASSERT_TRUE(r.success) << r.reason;
    const double e = gravity_error(r) / r.gravity_stddev_rad;
    ratio2 += e * e / trials;
    worst = std::max(worst, gravity_error(r));
    EXPECT_LT((r.bias.gyro - kTrueBias.gyro).norm(), 2e-3);
    EXPECT_LT((r.bias.accel - kTrueBias.accel).norm(), 5 * r.accel_bias_stddev);
  }
  // Two axes, the standard deviation is that of the worse one: between 1 and 2 when consistent.
  EXPECT_GT(ratio2, 0.3);
  EXPECT_LT(ratio2, 2.5);
  EXPECT_LT(worst, 0.5 * M_PI / 180);
}

TEST(InertialInit, GravityGuessSurvivesAWrongStart) {
  Case c = make_case({.position_noise = 2e-3}, 3);
  c.problem.v_world.assign(c.v_true.size(), Vector3d::Zero());
  c.problem.R_world_gravity = so3::exp({3.0, 0, 0}).toRotationMatrix();
  const InertialInitResult r = initialize_inertial(c.problem);
  ASSERT_TRUE(r.success) << r.reason;
  EXPECT_LT(gravity_error(r), 0.01);

  // Without the guess a given direction is refined.
  c.problem.guess_gravity = false;
  c.problem.R_world_gravity =
      kVisualFromTrue.rotation.toRotationMatrix() * so3::exp({0.1, 0.1, 0}).toRotationMatrix();
  const InertialInitResult refined = initialize_inertial(c.problem);
  ASSERT_TRUE(refined.success) << refined.reason;
  EXPECT_NEAR(gravity_error(refined), gravity_error(r), 1e-5);
}

TEST(InertialInit, StrongPriorHoldsTheBias) {
  Case c = make_case({}, 4);
  c.problem.accel_prior_information = 1e12;
  const InertialInitResult r = initialize_inertial(c.problem);
  EXPECT_LT(r.bias.accel.norm(), 1e-3);
  EXPECT_LT((r.bias.gyro - kTrueBias.gyro).norm(), 2e-3);
}

TEST(InertialInit, MoreKeyframesAreMoreCertain) {
  const InertialInitResult few = initialize_inertial(make_case({.keyframes = 6}, 5).problem);
  const InertialInitResult many = initialize_inertial(make_case({.keyframes = 50}, 5).problem);
  EXPECT_LT(many.gravity_stddev_rad, few.gravity_stddev_rad);
  EXPECT_LT(many.accel_bias_stddev, few.accel_bias_stddev);
}

TEST(InertialInit, ReportsTooLittleMotion) {
  InertialInitProblem p;
  std::vector<ImuSample> samples;
  for (int i = 0; i <= 1000; ++i)
    samples.push_back({i * 5'000'000LL, Vector3d::Zero(), -kGravityWorld});
  for (int i = 0; i < 10; ++i) {
    p.T_world_body.emplace_back();
    if (i < 9)
      p.between.push_back(std::make_shared<PreintegratedImu>(
          samples, i * 500'000'000LL, (i + 1) * 500'000'000LL, ImuBias{}, ImuCalibration{}));
  }
  const InertialInitResult r = initialize_inertial(p);
  EXPECT_FALSE(r.success);
  EXPECT_EQ(r.reason, "too little motion");
}

TEST(InertialInit, ReportsMeasurementsThatDoNotFit) {
  Case c = make_case({}, 6);
  for (SE3& T : c.problem.T_world_body) T = T.inverse();  // rotations the wrong way round
  const InertialInitResult inverted = initialize_inertial(c.problem);
  EXPECT_TRUE(!inverted.success || inverted.gravity_stddev_rad > 0.01);

  c = make_case({}, 6);
  c.problem.T_world_body[3].translation.y() = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(initialize_inertial(c.problem).success);
  EXPECT_FALSE(initialize_inertial(c.problem).reason.empty());
  EXPECT_FALSE(initialize_inertial({}).success);

  c = make_case({}, 6);
  c.problem.between[2] = nullptr;
  EXPECT_THROW(initialize_inertial(c.problem), InvalidArgument);
  c = make_case({}, 6);
  c.problem.between.pop_back();
  EXPECT_THROW(initialize_inertial(c.problem), InvalidArgument);
}

TEST(InertialInit, IsDeterministic) {
  const Case c = make_case({.position_noise = 2e-3}, 7);
  const InertialInitResult a = initialize_inertial(c.problem), b = initialize_inertial(c.problem);
  EXPECT_TRUE(a.R_world_gravity == b.R_world_gravity);
  EXPECT_TRUE(a.v_world == b.v_world);
}

}  // namespace
}  // namespace fastloop::optimization
