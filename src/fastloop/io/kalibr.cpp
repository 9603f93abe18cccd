#include <cmath>

#include "fastloop/io/calibration_import_detail.hpp"

namespace fastloop::io {
namespace {

constexpr double kMaxTranslationMismatchM = 2e-3;
constexpr double kMaxRotationMismatchRad = 2e-3;
constexpr double kMaxShiftDifferenceS = 1e-3;

CameraCalibration read_camera(const YamlNode& node) {
  CameraCalibration c;
  if (const auto model = node.find("camera_model"); model && model->text() != "pinhole")
    model->fail("'" + model->text() + "' is not supported", "pinhole");
  set_resolution(c.camera, node.required("resolution", "[width, height] in pixels"));
  set_intrinsics(c.camera, node.required("intrinsics", "[fx, fy, cx, cy] in pixels"));
  const auto coefficients = node.find("distortion_coeffs");
  set_distortion(c.camera, node.required("distortion_model", "radtan, equidistant or none"),
                 coefficients ? &*coefficients : nullptr);
  return c;
}

ImuCalibration read_imu(const std::optional<NamedText>& text, std::vector<std::string>& remarks) {
  if (!text) {
    remarks.push_back("no IMU noise file: noise of a common MEMS IMU is assumed");
    return {};
  }
  const YamlNode root = YamlNode::parse(text->text, text->file);
  // Kalibr's result nests the values under imu0, its input does not.
  const auto nested = root.find("imu0");
  return read_imu_noise(nested ? *nested : root, "update_rate");
}

/// Pose of the second camera: from its own T_cam_imu, or along the chain.
SE3 second_camera_pose(const YamlNode& cam1, const SE3& T_body_cam0, bool with_imu,
                       std::vector<std::string>& remarks) {
  const auto from_imu = with_imu ? cam1.find("T_cam_imu") : std::nullopt;
  const auto chained = cam1.find("T_cn_cnm1");
  if (!from_imu && !chained) cam1.required("T_cn_cnm1", "4x4 transformation from cam0 to cam1");
  if (!from_imu) return T_body_cam0 * chained->transform().inverse();
  const SE3 T_body_cam1 = from_imu->transform().inverse();
  if (chained) {
    const SE3 other = T_body_cam0 * chained->transform().inverse();
    if ((other.translation - T_body_cam1.translation).norm() > kMaxTranslationMismatchM ||
        angle_between(other, T_body_cam1) > kMaxRotationMismatchRad)
      remarks.push_back(cam1.file() +
                        ": cam1: T_cam_imu and T_cn_cnm1 contradict each other; T_cam_imu is used");
  }
  return T_body_cam1;
}

double read_time_shift(const YamlNode& cam0, const std::optional<YamlNode>& cam1,
                       std::vector<std::string>& remarks) {
  const auto read = [](const YamlNode& camera) {
    const auto shift = camera.find("timeshift_cam_imu");
    return shift ? shift->number() : 0.0;
  };
  const double shift = read(cam0);
  if (cam1 && std::abs(read(*cam1) - shift) > kMaxShiftDifferenceS)
    remarks.push_back(cam0.file() +
                      ": the cameras have different timeshift_cam_imu; that of cam0 is used");
  return shift;
}

}  // namespace

ImportedCalibration parse_kalibr(const NamedText& camchain, const std::optional<NamedText>& imu) {
  const YamlNode root = YamlNode::parse(camchain.text, camchain.file);
  ImportedCalibration result;
  result.kind = CalibrationKind::kKalibr;
  result.camera_rate_known = false;
  Calibration& c = result.calibration;

  const YamlNode cam0 = root.required("cam0", "the left camera");
  const YamlNode cam1 = root.required("cam1", "the right camera");
  c.cameras = {read_camera(cam0), read_camera(cam1)};
  if (root.has("cam2")) result.remarks.push_back(camchain.file + ": only cam0 and cam1 are used");
  const auto T_cam_imu = cam0.find("T_cam_imu");
  if (T_cam_imu) {
    c.cameras[0].T_body_camera = T_cam_imu->transform().inverse();
    c.imu = read_imu(imu, result.remarks);
    c.imu->time_shift_s = read_time_shift(cam0, cam1, result.remarks);
  } else {
    result.remarks.push_back(camchain.file + ": no T_cam_imu: cameras only, the body is cam0");
  }
  c.cameras[1].T_body_camera =
      second_camera_pose(cam1, c.cameras[0].T_body_camera, T_cam_imu.has_value(), result.remarks);
  check_calibration(c, camchain.file);
  return result;
}

}  // namespace fastloop::io
