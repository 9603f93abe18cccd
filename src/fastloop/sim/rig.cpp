#include "fastloop/sim/rig.hpp"

#include "fastloop/core/error.hpp"

namespace fastloop::sim {
namespace {

SE3 pose_from_rows(const std::array<double, 12>& m) {
  Matrix3d r;
  r << m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10];
  return SE3(r, Vector3d(m[3], m[7], m[11]));
}

CameraCalibration camera(CameraModel model, int width, int height, const Eigen::Vector4d& k,
                         const std::array<double, 5>& distortion, const SE3& T_body_camera,
                         double rate_hz) {
  CameraCalibration c;
  c.camera.model = model;
  c.camera.width = width;
  c.camera.height = height;
  c.camera.fx = k[0];
  c.camera.fy = k[1];
  c.camera.cx = k[2];
  c.camera.cy = k[3];
  c.camera.distortion = distortion;
  c.T_body_camera = T_body_camera;
  c.rate_hz = rate_hz;
  return c;
}

ImuCalibration imu_adis16448() {
  ImuCalibration imu;
  imu.rate_hz = 200;
  imu.gyro_noise_density = 1.6968e-4;
  imu.gyro_random_walk = 1.9393e-5;
  imu.accel_noise_density = 2.0e-3;
  imu.accel_random_walk = 3.0e-3;
  return imu;
}

Calibration euroc_rig() {
  Calibration c;
  c.cameras.push_back(camera(
      CameraModel::kPinhole, 752, 480, {458.654, 457.296, 367.215, 248.375},
      {-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0},
      pose_from_rows({0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
                      0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
                      -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949}),
      20));
  c.cameras.push_back(camera(
      CameraModel::kPinhole, 752, 480, {457.587, 456.134, 379.999, 255.238},
      {-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05, 0},
      pose_from_rows({0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556,
                      0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024,
                      -0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038}),
      20));
  c.imu = imu_adis16448();
  return c;
}

Calibration tumvi_rig() {
  Calibration c;
  const SE3 T_body_cam0 = pose_from_rows(
      {-0.9995250378696743, 0.0075019185074052044, -0.02989013031643309, 0.045574835649698026,
       0.029615343885863205, -0.03439736061393144, -0.998969345370175, -0.071161801837997044,
       -0.008522328211654736, -0.9993800792498829, 0.03415885127385616, -0.044681254117144367});
  const SE3 T_cam0_cam1 = pose_from_rows(
      {0.999999445773493, 0.000791687752817, 0.000694034010224, 0.101063427414194,
       -0.000823363992158, 0.998899461915674, 0.046895490788700, 0.001946204678584,
       -0.000656143613644, -0.046896036240590, 0.998899560146304, 0.001015350132563});
  c.cameras.push_back(camera(CameraModel::kKannalaBrandt, 512, 512,
                             {190.97847715128717, 190.9733070521226, 254.93170605935475,
                              256.8974428996504},
                             {0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202,
                              0.00020293673591811182, 0},
                             T_body_cam0, 20));
  c.cameras.push_back(camera(CameraModel::kKannalaBrandt, 512, 512,
                             {190.44236969414825, 190.4344384721956, 252.59949716835982,
                              254.91723064636983},
                             {0.0034003170790442797, 0.001766278153469831, -0.00266312569781606,
                              0.0003299517423931039, 0},
                             T_body_cam0 * T_cam0_cam1, 20));
  c.imu = imu_adis16448();
  return c;
}

Calibration rgbd_rig() {
  Calibration c;
  c.cameras.push_back(
      camera(CameraModel::kPinhole, 640, 480, {525, 525, 319.5, 239.5}, {}, SE3(), 30));
  DepthCalibration depth;
  depth.units_per_metre = 5000;
  depth.max_depth_m = 8;
  c.depth = depth;
  return c;
}

}  // namespace

CameraKind parse_camera_kind(const std::string& name) {
  if (name == "pinhole") return CameraKind::kPinhole;
  if (name == "fisheye") return CameraKind::kFisheye;
  if (name == "rgbd") return CameraKind::kRgbd;
  throw InvalidArgument("unknown camera '" + name + "' (expected pinhole, fisheye or rgbd)");
}

std::string to_string(CameraKind kind) {
  return kind == CameraKind::kPinhole ? "pinhole" : kind == CameraKind::kFisheye ? "fisheye" : "rgbd";
}

Calibration make_rig(CameraKind kind) {
  if (kind == CameraKind::kPinhole) return euroc_rig();
  if (kind == CameraKind::kFisheye) return tumvi_rig();
  return rgbd_rig();
}

Eigen::Quaterniond carrier_from_body(const Calibration& calibration) {
  Matrix3d R_carrier_camera;  // camera x = right, y = down, z = forward
  R_carrier_camera << 0, 0, 1, -1, 0, 0, 0, -1, 0;
  return Eigen::Quaterniond(R_carrier_camera) *
         calibration.cameras.at(0).T_body_camera.rotation.conjugate();
}

}  // namespace fastloop::sim
