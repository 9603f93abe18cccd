#include "fastloop/io/calibration_import.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/io/calibration_report.hpp"
#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/test_support.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;
using testing::AllOf;
using testing::Contains;
using testing::HasSubstr;
using testing::IsEmpty;

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  return text.replace(at, from.size(), to);
}

const std::string kKalibr = R"(cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.01]
  - [-1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.0075
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, -0.0001, -3.6e-05]
  distortion_model: radtan
  intrinsics: [457.6, 456.1, 380.0, 255.2]
  resolution: [752, 480]
  timeshift_cam_imu: -0.0075
)";

const std::string kKalibrImu = R"(rostopic: /imu0
update_rate: 400.0
accelerometer_noise_density: 0.0028
accelerometer_random_walk: 0.00086
gyroscope_noise_density: 0.00016
gyroscope_random_walk: 0.000022
)";

const std::string kOrbSlam = R"(%YAML:1.0

File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.978
Camera1.fy: 190.973
Camera1.cx: 254.931
Camera1.cy: 256.897
Camera1.k1: 0.0034
Camera1.k2: 0.0007
Camera1.k3: -0.002
Camera1.k4: 0.0002
Camera2.fx: 190.442
Camera2.fy: 190.434
Camera2.cx: 252.597
Camera2.cy: 254.917
Camera2.k1: 0.0034
Camera2.k2: 0.0017
Camera2.k3: -0.0026
Camera2.k4: 0.0003
Camera.width: 512
Camera.height: 512
Camera.fps: 20
Stereo.T_c1_c2: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1.0, 0.0, 0.0, 0.101,
          0.0, 1.0, 0.0, 0.0,
          0.0, 0.0, 1.0, 0.0,
          0.0, 0.0, 0.0, 1.0]
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [0.0, -1.0, 0.0, 0.045,
          1.0, 0.0, 0.0, -0.071,
          0.0, 0.0, 1.0, -0.044,
          0.0, 0.0, 0.0, 1.0]
IMU.NoiseGyro: 0.00016
IMU.NoiseAcc: 0.0028
IMU.GyroWalk: 0.000022
IMU.AccWalk: 0.00086
IMU.Frequency: 200.0
ORBextractor.nFeatures: 1500
Viewer.PointSize: 2.0
)";

TEST(CalibrationImport, KalibrFramesAndTimeShift) {
  const auto imported = parse_kalibr({kKalibr, "chain.yaml"}, NamedText{kKalibrImu, "imu.yaml"});
  EXPECT_THAT(imported.remarks, IsEmpty());
  const Calibration& c = imported.calibration;
  // T_cam_imu takes a point of the IMU frame into the camera.
  const Vector3d p_imu(0.3, 0.4, 0.5), p_cam(0.41, -0.28, 0.53);
  EXPECT_LT((c.cameras[0].T_body_camera * p_cam - p_imu).norm(), 1e-12);
  EXPECT_LT((c.cameras[1].T_body_camera * (p_cam - Vector3d(0.11, 0, 0)) - p_imu).norm(), 1e-12);
  EXPECT_EQ(c.imu->time_shift_s, -0.0075);
  EXPECT_EQ(c.imu->rate_hz, 400);
  EXPECT_EQ(c.imu->gyro_noise_density, 0.00016);
  EXPECT_EQ(c.imu->accel_random_walk, 0.00086);
  EXPECT_EQ(c.cameras[1].camera.distortion[2], -0.0001);
  EXPECT_FALSE(imported.camera_rate_known);
}

TEST(CalibrationImport, KalibrAssumptionsAreRemarked) {
  EXPECT_THAT(parse_kalibr({kKalibr, "chain.yaml"}, {}).remarks,
              Contains(HasSubstr("no IMU noise file")));
  const std::string shifted =
      replaced(kKalibr, "resolution: [752, 480]\n  timeshift_cam_imu: -0.0075",
               "resolution: [752, 480]\n  timeshift_cam_imu: 0.01");
  EXPECT_THAT(parse_kalibr({shifted, "chain.yaml"}, {}).remarks,
              Contains(HasSubstr("different timeshift_cam_imu")));
  const std::string contradicting =
      replaced(kKalibr, "cam1:\n",
               "cam1:\n  T_cam_imu: [[0, 1, 0, -0.2], [-1, 0, 0, 0.02], [0, 0, 1, 0.03], "
               "[0, 0, 0, 1]]\n");
  const auto imported = parse_kalibr({contradicting, "chain.yaml"}, {});
  EXPECT_THAT(imported.remarks, Contains(HasSubstr("contradict")));
  // Cameras alone: the body is cam0.
  const std::string cameras_only = replaced(kKalibr, "T_cam_imu", "T_something");
  const auto stereo = parse_kalibr({cameras_only, "chain.yaml"}, {});
  EXPECT_FALSE(stereo.calibration.imu);
  EXPECT_NEAR(stereo.calibration.cameras[1].T_body_camera.translation.x(), 0.11, 1e-12);
}

TEST(CalibrationImport, KalibrComplaintsNameFileLineAndKey) {
  struct Case {
    std::string text;
    std::vector<std::string> parts;
  };
  const std::vector<Case> cases = {
      {replaced(kKalibr, "camera_model: pinhole", "camera_model: omni"),
       {"chain.yaml:8:", "cam0.camera_model", "'omni'", "pinhole"}},
      {replaced(kKalibr, "distortion_model: radtan", "distortion_model: fov"),
       {"chain.yaml:10:", "cam0.distortion_model", "'fov'"}},
      {replaced(kKalibr, "-0.28, 0.07, 0.0002", "-0.28, .inf, 0.0002"),
       {"chain.yaml:9:", "distortion_coeffs[1]", "not finite"}},
      {replaced(kKalibr, "- [0.0, 1.0, 0.0, 0.01]", "- [0.0, 2.0, 0.0, 0.01]"),
       {"chain.yaml:2:", "cam0.T_cam_imu", "orthonormal"}},
      {replaced(kKalibr, "T_cn_cnm1", "T_other"), {"chain.yaml:15:", "cam1.T_cn_cnm1", "missing"}},
      {replaced(kKalibr, "cam1:", "cam2:"), {"chain.yaml", "cam1", "missing"}},
      {replaced(kKalibr, "timeshift_cam_imu: -0.0075", "timeshift_cam_imu: -75"),
       {"chain.yaml", "time_shift_s"}},
  };
  for (const Case& c : cases) {
    const std::string message = input_error([&] { parse_kalibr({c.text, "chain.yaml"}, {}); });
    for (const std::string& part : c.parts) EXPECT_THAT(message, HasSubstr(part)) << c.text;
  }
  const std::string noise = replaced(kKalibrImu, "gyroscope_random_walk: 0.000022", "");
  EXPECT_THAT(
      input_error([&] {
        parse_kalibr({kKalibr, "chain.yaml"}, NamedText{noise, "imu.yaml"});
      }),
      AllOf(HasSubstr("imu.yaml"), HasSubstr("gyroscope_random_walk"), HasSubstr("missing")));
}

TEST(CalibrationImport, OrbSlamFisheyeStereoInertial) {
  const auto imported = parse_orb_slam({kOrbSlam, "orb.yaml"});
  const Calibration& c = imported.calibration;
  EXPECT_THAT(imported.remarks, IsEmpty());
  EXPECT_EQ(c.cameras[0].camera.model, CameraModel::kKannalaBrandt);
  EXPECT_EQ(c.cameras[1].camera.distortion[1], 0.0017);
  EXPECT_LT(
      (c.cameras[0].T_body_camera * Vector3d(1, 0, 0) - Vector3d(0.045, 0.929, -0.044)).norm(),
      1e-12);
  // The right camera sits 0.101 m along the left one's x axis.
  EXPECT_LT((c.cameras[1].T_body_camera.translation - Vector3d(0.045, 0.030, -0.044)).norm(),
            1e-12);
  EXPECT_EQ(c.imu->accel_noise_density, 0.0028);
  EXPECT_EQ(c.imu->gyro_random_walk, 0.000022);
  EXPECT_FALSE(c.depth);
}

TEST(CalibrationImport, OrbSlamRectifiedAndRgbd) {
  const std::string camera =
      "Camera1.fx: 700\nCamera1.fy: 700\nCamera1.cx: 600\nCamera1.cy: 180\nCamera1.k1: "
      "0.1\nCamera.width: 1241\n"
      "Camera.height: 376\n";
  const auto stereo =
      parse_orb_slam({"Camera.type: \"Rectified\"\nStereo.b: 0.54\n" + camera, "orb.yaml"});
  EXPECT_TRUE(stereo.calibration.cameras[1].camera.is_ideal_pinhole());
  EXPECT_NEAR(stereo.calibration.cameras[1].T_body_camera.translation.x(), 0.54, 1e-12);
  EXPECT_FALSE(stereo.camera_rate_known);
  EXPECT_THAT(stereo.remarks, Contains(HasSubstr("no IMU.T_b_c1")));

  const auto rgbd = parse_orb_slam(
      {"Camera.type: \"PinHole\"\nStereo.b: 0.0745\nRGBD.DepthMapFactor: 5208.0\n" + camera,
       "orb.yaml"});
  ASSERT_TRUE(rgbd.calibration.depth);
  EXPECT_EQ(rgbd.calibration.cameras.size(), 1u);
  EXPECT_EQ(rgbd.calibration.depth->units_per_metre, 5208);
  EXPECT_EQ(rgbd.calibration.depth->virtual_baseline_m, 0.0745);
  EXPECT_EQ(rgbd.calibration.cameras[0].camera.distortion[0], 0.1);

  const std::string old =
      "Camera.type: PinHole\nCamera.fx: 500\nCamera.fy: 500\nCamera.cx: 320\nCamera.cy: "
      "240\nCamera.width: 640\n"
      "Camera.height: 480\nCamera.bf: 40\nDepthMapFactor: 1000\n";
  EXPECT_EQ(parse_orb_slam({old, "orb.yaml"}).calibration.depth->virtual_baseline_m, 0.08);
}

TEST(CalibrationImport, OrbSlamComplaintsNameFileLineAndKey) {
  struct Case {
    std::string text;
    std::vector<std::string> parts;
  };
  const std::vector<Case> cases = {
      {replaced(kOrbSlam, "KannalaBrandt8", "Omni"), {"orb.yaml:4:", "Camera.type", "'Omni'"}},
      {replaced(kOrbSlam, "Camera1.k3: -0.002\n", ""), {"orb.yaml", "Camera1.k3", "missing"}},
      {replaced(kOrbSlam, "Camera1.fx: 190.978", "Camera1.fx: -1"),
       {"orb.yaml:5:", "Camera1.fx", "> 0"}},
      {replaced(kOrbSlam, "Camera2.cy: 254.917", "Camera2.cy: nan"),
       {"orb.yaml:16:", "Camera2.cy", "not finite"}},
      {replaced(kOrbSlam, "[1.0, 0.0, 0.0, 0.101,", "[1.0, 0.0, 0.101,"),
       {"orb.yaml:28:", "Stereo.T_c1_c2.data", "15 numbers"}},
      {replaced(kOrbSlam, "Stereo.T_c1_c2", "Stereo.other"),
       {"orb.yaml", "Stereo.T_c1_c2", "missing"}},
      {replaced(kOrbSlam, "IMU.NoiseAcc: 0.0028\n", ""), {"orb.yaml", "IMU.NoiseAcc", "m / s^2"}},
      {kOrbSlam + "LEFT.K: 3\n", {"orb.yaml:47:", "LEFT.K", "version 1.0"}},
  };
  for (const Case& c : cases) {
    const std::string message = input_error([&] { parse_orb_slam({c.text, "orb.yaml"}); });
    for (const std::string& part : c.parts) EXPECT_THAT(message, HasSubstr(part)) << c.text;
  }
}

TEST(CalibrationImport, RecognisesTheKindOfAFile) {
  const TemporaryFolder folder;
  const auto chain = folder.write("run-camchain-imucam.yaml", kKalibr);
  // Kalibr's own result nests the noise under imu0.
  std::string nested = "imu0:\n";
  for (std::size_t at = 0, end = 0; (end = kKalibrImu.find('\n', at)) != std::string::npos;
       at = end + 1)
    nested += "  " + kKalibrImu.substr(at, end - at) + "\n";
  folder.write("run-imu.yaml", nested);
  const auto kalibr = import_calibration(chain);
  EXPECT_EQ(kalibr.kind, CalibrationKind::kKalibr);
  EXPECT_EQ(kalibr.calibration.imu->rate_hz, 400) << "the file beside the camchain is found";

  EXPECT_EQ(import_calibration(folder.write("orb.yaml", kOrbSlam)).kind, CalibrationKind::kOrbSlam);
  save_calibration(folder.path() / "own.yaml", kalibr.calibration);
  EXPECT_EQ(import_calibration(folder.path() / "own.yaml").kind, CalibrationKind::kFastloop);
  const EurocFolder euroc(folder, 1);
  for (const fs::path& path : {euroc.root, euroc.mav(), euroc.mav() / "cam0" / "sensor.yaml"}) {
    const auto imported = import_calibration(path);
    EXPECT_EQ(imported.kind, CalibrationKind::kEuroc);
    EXPECT_EQ(imported.calibration.cameras.size(), 2u);
    EXPECT_TRUE(imported.calibration.imu);
  }
  EXPECT_THAT(
      input_error([&] { import_calibration(folder.write("other.yaml", "a: 1\n")); }),
      AllOf(HasSubstr("other.yaml"), HasSubstr("not a known calibration"), HasSubstr("Kalibr")));
  EXPECT_THAT(input_error([&] {
                import_calibration(folder.path() / "own.yaml", folder.path() / "run-imu.yaml");
              }),
              HasSubstr("Kalibr camchain only"));
  EXPECT_THAT(input_error([&] { import_calibration(folder.path() / "none.yaml"); }),
              HasSubstr("cannot be opened"));
}

TEST(CalibrationReport, SaysWhatAPersonCanCheck) {
  const Calibration c = parse_kalibr({kKalibr, "chain.yaml"}, {}).calibration;
  const std::string text = describe_calibration(c);
  EXPECT_THAT(text, AllOf(HasSubstr("baseline      0.1100 m"), HasSubstr("0.000 deg"),
                          HasSubstr("90.00 deg"), HasSubstr("-0.007500 s")));
  EXPECT_THAT(text, testing::Not(HasSubstr("unusual")));
}

TEST(CalibrationReport, FieldOfViewOfAnIdealFisheyeIsExact) {
  Calibration c = parse_orb_slam({kOrbSlam, "orb.yaml"}).calibration;
  // Equidistant without higher terms: the angle is the distance from the centre over f.
  Camera& camera = c.cameras[0].camera;
  camera.distortion = {};
  camera.fx = camera.fy = 511 / (200.0 * M_PI / 180);
  camera.cx = camera.cy = 255.5;
  EXPECT_THAT(describe_calibration(c), HasSubstr("field of view 200.0 x 200.0 deg"));
}

TEST(CalibrationReport, PointsOutSwappedCameras) {
  Calibration c = parse_kalibr({kKalibr, "chain.yaml"}, {}).calibration;
  std::swap(c.cameras[0], c.cameras[1]);
  EXPECT_THAT(describe_calibration(c), HasSubstr("unusual       cam1 is not to the right of cam0"));
}

}  // namespace
}  // namespace fastloop::io
