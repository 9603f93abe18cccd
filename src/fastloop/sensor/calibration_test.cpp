#include "fastloop/sensor/calibration.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <functional>
#include <limits>

#include "fastloop/core/error.hpp"

namespace fastloop {
namespace {

Calibration stereo_inertial() {
  Calibration c;
  c.cameras.resize(2);
  for (CameraCalibration& cam : c.cameras) {
    cam.camera.width = 752;
    cam.camera.height = 480;
    cam.camera.fx = cam.camera.fy = 458;
    cam.camera.cx = 367;
    cam.camera.cy = 248;
  }
  c.cameras[1].T_body_camera.translation.x() = 0.11;
  c.imu.emplace();
  return c;
}

Calibration rgbd() {
  Calibration c = stereo_inertial();
  c.cameras.resize(1);
  c.imu.reset();
  c.depth.emplace();
  return c;
}

TEST(Calibration, AcceptsStereoInertialStereoAndRgbd) {
  EXPECT_NO_THROW(stereo_inertial().validate());
  Calibration stereo = stereo_inertial();
  stereo.imu.reset();
  EXPECT_NO_THROW(stereo.validate());
  EXPECT_NO_THROW(rgbd().validate());
}

TEST(Calibration, NamesTheFirstValueThatCannotBeRight) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  struct Case {
    std::string named;
    std::function<void(Calibration&)> spoil;
  };
  const std::vector<Case> cases = {
      {"cameras", [](Calibration& c) { c.cameras.clear(); }},
      {"cam0: image size", [](Calibration& c) { c.cameras[0].camera.width = 0; }},
      {"cam1: focal lengths", [](Calibration& c) { c.cameras[1].camera.fy = -1; }},
      {"cam1: distortion", [&](Calibration& c) { c.cameras[1].camera.distortion[2] = nan; }},
      {"cam0.T_body_camera",
       [&](Calibration& c) { c.cameras[0].T_body_camera.translation.y() = nan; }},
      {"cam1.T_body_camera",
       [](Calibration& c) { c.cameras[1].T_body_camera = c.cameras[0].T_body_camera; }},
      {"cam0.rate_hz", [](Calibration& c) { c.cameras[0].rate_hz = 0; }},
      {"depth", [](Calibration& c) { c.cameras.resize(1); }},
      {"depth", [](Calibration& c) { c.depth.emplace(); }},
      {"imu.gyro_noise_density", [](Calibration& c) { c.imu->gyro_noise_density = 0; }},
      {"imu.accel_random_walk", [&](Calibration& c) { c.imu->accel_random_walk = nan; }},
      {"imu.time_shift_s", [&](Calibration& c) { c.imu->time_shift_s = nan; }},
  };
  for (const Case& test_case : cases) {
    Calibration c = stereo_inertial();
    test_case.spoil(c);
    try {
      c.validate();
      ADD_FAILURE() << "accepted a wrong " << test_case.named;
    } catch (const InvalidArgument& e) {
      EXPECT_THAT(e.what(), testing::HasSubstr(test_case.named));
    }
  }
}

TEST(Calibration, RejectsWrongDepthScale) {
  Calibration c = rgbd();
  c.depth->units_per_metre = 0;
  try {
    c.validate();
    FAIL() << "accepted";
  } catch (const InvalidArgument& e) {
    EXPECT_THAT(e.what(), testing::HasSubstr("depth.units_per_metre"));
  }
}

}  // namespace
}  // namespace fastloop
