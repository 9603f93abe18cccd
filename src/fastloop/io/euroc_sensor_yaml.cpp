#include "fastloop/io/calibration_import_detail.hpp"

namespace fastloop::io {
namespace {

CameraCalibration read_camera(const NamedText& text) {
  const YamlNode root = YamlNode::parse(text.text, text.file);
  CameraCalibration c;
  if (const auto model = root.find("camera_model"); model && model->text() != "pinhole")
    model->fail("'" + model->text() + "' is not supported", "pinhole");
  if (const auto rate = root.find("rate_hz")) c.rate_hz = rate->positive_number();
  set_resolution(c.camera, root.required("resolution", "[width, height] in pixels"));
  set_intrinsics(c.camera, root.required("intrinsics", "[fu, fv, cu, cv] in pixels"));
  const auto coefficients = root.find("distortion_coefficients");
  set_distortion(c.camera, root.required("distortion_model", "radial-tangential or equidistant"),
                 coefficients ? &*coefficients : nullptr);
  c.T_body_camera =
      root.required("T_BS", "4x4 transformation from the camera to the body").transform();
  return c;
}

}  // namespace

ImportedCalibration parse_euroc_sensors(const std::vector<NamedText>& cameras,
                                        const std::optional<NamedText>& imu) {
  ImportedCalibration result;
  result.kind = CalibrationKind::kEuroc;
  Calibration& c = result.calibration;
  for (const NamedText& text : cameras) c.cameras.push_back(read_camera(text));

  // EuRoC's body frame B may be any frame; ours is the IMU's, or cam0's when there is no IMU.
  SE3 T_B_body = c.cameras.at(0).T_body_camera;
  if (imu) {
    const YamlNode root = YamlNode::parse(imu->text, imu->file);
    c.imu = read_imu_noise(root, "rate_hz");
    const auto T_BS = root.find("T_BS");
    T_B_body = T_BS ? T_BS->transform() : SE3();
  } else {
    result.remarks.push_back("no imu0/sensor.yaml: the body frame is that of cam0");
  }
  for (CameraCalibration& camera : c.cameras)
    camera.T_body_camera = T_B_body.inverse() * camera.T_body_camera;
  check_calibration(c, cameras[0].file);
  return result;
}

}  // namespace fastloop::io
