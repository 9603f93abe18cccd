#include "fastloop/io/calibration_import_detail.hpp"

namespace fastloop::io {
namespace {

/// Keys "Camera1.fx", "Camera1.k1", ... of one camera. `prefix` ends with the point.
struct CameraKeys {
  const YamlNode& root;
  std::string prefix;

  double number(const char* name, const char* expected) const {
    return root.required(prefix + name, expected).number();
  }
  double positive(const char* name) const {
    return root.required(prefix + name, "a focal length in pixels").positive_number();
  }
  double optional(const char* name) const {
    const auto node = root.find(prefix + name);
    return node ? node->number() : 0;
  }
};

Camera read_camera(const CameraKeys& keys, CameraModel model, bool distorted) {
  const YamlNode& root = keys.root;
  Camera c;
  c.model = model;
  const auto size = [&](const char* name) {
    const YamlNode node = root.required(name, "image size in pixels");
    const int value = node.integer();
    if (value <= 0) node.fail("is not an image size", "a whole number > 0");
    return value;
  };
  c.width = size("Camera.width");
  c.height = size("Camera.height");
  c.fx = keys.positive("fx");
  c.fy = keys.positive("fy");
  c.cx = keys.number("cx", "principal point in pixels");
  c.cy = keys.number("cy", "principal point in pixels");
  if (model == CameraModel::kKannalaBrandt) {
    const char* names[] = {"k1", "k2", "k3", "k4"};
    for (std::size_t i = 0; i < 4; ++i)
      c.distortion[i] = keys.number(names[i], "a distortion coefficient");
  } else if (distorted) {
    c.distortion = {keys.optional("k1"), keys.optional("k2"), keys.optional("p1"),
                    keys.optional("p2"), keys.optional("k3")};
  }
  return c;
}

ImuCalibration read_imu(const YamlNode& root) {
  ImuCalibration imu;
  const auto read = [&](const char* name, const char* unit) {
    return root.required(name, unit).positive_number();
  };
  imu.gyro_noise_density = read("IMU.NoiseGyro", "rad / s / sqrt(Hz)");
  imu.accel_noise_density = read("IMU.NoiseAcc", "m / s^2 / sqrt(Hz)");
  imu.gyro_random_walk = read("IMU.GyroWalk", "rad / s^2 / sqrt(Hz)");
  imu.accel_random_walk = read("IMU.AccWalk", "m / s^3 / sqrt(Hz)");
  imu.rate_hz = read("IMU.Frequency", "Hz");
  return imu;
}

std::string camera_type(const YamlNode& root) {
  const YamlNode node = root.required("Camera.type", "PinHole, Rectified or KannalaBrandt8");
  const std::string type = node.text();
  if (type != "PinHole" && type != "Rectified" && type != "KannalaBrandt8")
    node.fail("'" + type + "' is not supported", "PinHole, Rectified or KannalaBrandt8");
  return type;
}

/// Distance between rectified cameras, or of the virtual camera of an RGB-D sensor.
std::optional<double> read_baseline(const YamlNode& root, double fx) {
  if (const auto b = root.find("Stereo.b")) return b->positive_number();
  if (const auto bf = root.find("Camera.bf")) return bf->positive_number() / fx;
  return std::nullopt;
}

void add_second_camera(const YamlNode& root, CameraModel model, bool distorted, Calibration& c) {
  CameraCalibration right = c.cameras[0];
  const SE3 T_body_left = c.cameras[0].T_body_camera;
  if (root.has("Camera2.fx")) {
    right.camera = read_camera({root, "Camera2."}, model, distorted);
    const SE3 T_left_right =
        root.required("Stereo.T_c1_c2", "4x4 transformation from the right camera to the left")
            .transform();
    right.T_body_camera = T_body_left * T_left_right;
  } else {
    const auto baseline = read_baseline(root, right.camera.fx);
    if (!baseline) root.required("Stereo.b", "distance between the cameras in metres");
    right.T_body_camera =
        T_body_left * SE3(Eigen::Quaterniond::Identity(), Vector3d(*baseline, 0, 0));
  }
  c.cameras.push_back(right);
}

}  // namespace

ImportedCalibration parse_orb_slam(const NamedText& settings) {
  const YamlNode root = YamlNode::parse(settings.text, settings.file);
  if (const auto old = root.find("LEFT.K"))
    old->fail("stereo rectification inside the settings is not supported",
              "settings of version 1.0 with Camera1, Camera2 and Stereo.T_c1_c2");
  ImportedCalibration result;
  result.kind = CalibrationKind::kOrbSlam;
  Calibration& c = result.calibration;

  const std::string type = camera_type(root);
  const bool rectified = type == "Rectified";
  const CameraModel model =
      type == "KannalaBrandt8" ? CameraModel::kKannalaBrandt : CameraModel::kPinhole;
  CameraCalibration left;
  left.camera =
      read_camera({root, root.has("Camera1.fx") ? "Camera1." : "Camera."}, model, !rectified);
  if (const auto fps = root.find("Camera.fps")) {
    left.rate_hz = fps->positive_number();
  } else {
    result.camera_rate_known = false;
  }
  const auto T_b_c1 = root.has("IMU.T_b_c1") ? root.find("IMU.T_b_c1") : root.find("Tbc");
  if (T_b_c1) {
    left.T_body_camera = T_b_c1->transform();
    c.imu = read_imu(root);
  } else {
    result.remarks.push_back(settings.file +
                             ": no IMU.T_b_c1: cameras only, the body is the left one");
  }
  c.cameras.push_back(left);

  auto factor = root.find("RGBD.DepthMapFactor");
  if (!factor) factor = root.find("DepthMapFactor");
  if (factor && !root.has("Camera2.fx")) {
    c.depth.emplace().units_per_metre = factor->positive_number();
    if (const auto baseline = read_baseline(root, left.camera.fx))
      c.depth->virtual_baseline_m = *baseline;
  } else {
    add_second_camera(root, model, !rectified, c);
  }
  check_calibration(c, settings.file);
  return result;
}

}  // namespace fastloop::io
