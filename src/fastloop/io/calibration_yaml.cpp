#include "fastloop/io/calibration_yaml.hpp"

#include <cstdio>
#include <sstream>

#include "fastloop/core/error.hpp"
#include "fastloop/io/text.hpp"
#include "fastloop/io/yaml_node.hpp"

namespace fastloop::io {
namespace {

constexpr const char* kPinhole = "pinhole-radtan";
constexpr const char* kFisheye = "kannala-brandt";

CameraCalibration read_camera(const YamlNode& node) {
  node.allow_only({"model", "resolution", "intrinsics", "distortion", "rate_hz"});
  CameraCalibration c;
  const YamlNode model = node.required("model", "pinhole-radtan or kannala-brandt");
  if (model.text() == kFisheye) {
    c.camera.model = CameraModel::kKannalaBrandt;
  } else if (model.text() != kPinhole) {
    model.fail("'" + model.text() + "' is an unknown camera model",
               "pinhole-radtan or kannala-brandt");
  }
  const YamlNode resolution = node.required("resolution", "[width, height] in pixels");
  resolution.numbers(2, 2);
  const auto sides = resolution.items();
  if (sides.size() != 2) resolution.fail("is nested", "[width, height] in pixels");
  c.camera.width = sides[0].integer();
  c.camera.height = sides[1].integer();
  if (c.camera.width <= 0 || c.camera.height <= 0)
    resolution.fail("is not an image size", "two whole numbers > 0");

  const YamlNode intrinsics = node.required("intrinsics", "[fx, fy, cx, cy] in pixels");
  const auto k = intrinsics.numbers(4, 4);
  if (k[0] <= 0 || k[1] <= 0)
    intrinsics.fail("has a focal length that is not positive", "fx, fy > 0");
  c.camera.fx = k[0], c.camera.fy = k[1], c.camera.cx = k[2], c.camera.cy = k[3];

  const bool fisheye = c.camera.model == CameraModel::kKannalaBrandt;
  const auto d = node.required("distortion", fisheye ? "[k1, k2, k3, k4]" : "[k1, k2, p1, p2]")
                     .numbers(4, fisheye ? 4 : 5);
  std::copy(d.begin(), d.end(), c.camera.distortion.begin());
  if (const auto rate = node.find("rate_hz")) c.rate_hz = rate->positive_number();
  return c;
}

ImuCalibration read_imu(const YamlNode& node) {
  node.allow_only({"rate_hz", "gyro_noise_density", "gyro_random_walk", "accel_noise_density",
                   "accel_random_walk", "time_shift_s"});
  ImuCalibration imu;
  const auto read = [&](const char* name, const char* unit) {
    return node.required(name, unit).positive_number();
  };
  if (const auto rate = node.find("rate_hz")) imu.rate_hz = rate->positive_number();
  imu.gyro_noise_density = read("gyro_noise_density", "rad / s / sqrt(Hz)");
  imu.gyro_random_walk = read("gyro_random_walk", "rad / s^2 / sqrt(Hz)");
  imu.accel_noise_density = read("accel_noise_density", "m / s^2 / sqrt(Hz)");
  imu.accel_random_walk = read("accel_random_walk", "m / s^3 / sqrt(Hz)");
  if (const auto shift = node.find("time_shift_s")) imu.time_shift_s = shift->number();
  return imu;
}

DepthCalibration read_depth(const YamlNode& node) {
  node.allow_only({"units_per_metre", "virtual_baseline_m", "max_depth_m"});
  DepthCalibration depth;
  depth.units_per_metre =
      node.required("units_per_metre", "stored value of one metre").positive_number();
  if (const auto b = node.find("virtual_baseline_m"))
    depth.virtual_baseline_m = b->positive_number();
  if (const auto far = node.find("max_depth_m")) depth.max_depth_m = far->positive_number();
  return depth;
}

std::string digits(double value) {
  // The shortest of 15 to 17 digits that gives the same number back.
  char buffer[40];
  for (int precision = 15; precision <= 17; ++precision) {
    std::snprintf(buffer, sizeof buffer, "%.*g", precision, value);
    if (parse_number(buffer) == value) break;
  }
  return buffer;
}

void write_transform(std::ostream& out, const std::string& name, const SE3& T) {
  const Eigen::Matrix4d m = T.matrix();
  out << name << ":  # p_body = " << name << " * p_camera; 4x4, row by row; metres\n";
  for (int r = 0; r < 4; ++r)
    out << (r == 0 ? "  [" : "   ") << digits(m(r, 0)) << ", " << digits(m(r, 1)) << ", "
        << digits(m(r, 2)) << ", " << digits(m(r, 3)) << (r == 3 ? "]\n" : ",\n");
}

void write_camera(std::ostream& out, const CameraCalibration& c) {
  const Camera& cam = c.camera;
  const bool fisheye = cam.model == CameraModel::kKannalaBrandt;
  out << "  - model: " << (fisheye ? kFisheye : kPinhole) << "\n"
      << "    resolution: [" << cam.width << ", " << cam.height << "]  # width, height; pixels\n"
      << "    intrinsics: [" << digits(cam.fx) << ", " << digits(cam.fy) << ", " << digits(cam.cx)
      << ", " << digits(cam.cy) << "]  # fx, fy, cx, cy; pixels\n    distortion: [";
  const std::size_t count = !fisheye && cam.distortion[4] != 0 ? 5 : 4;
  for (std::size_t i = 0; i < count; ++i) out << (i ? ", " : "") << digits(cam.distortion[i]);
  out << "]  # " << (fisheye ? "k1, k2, k3, k4" : "k1, k2, p1, p2[, k3]") << "\n"
      << "    rate_hz: " << digits(c.rate_hz) << "\n";
}

void write_imu(std::ostream& out, const ImuCalibration& imu) {
  out << "\nimu:\n"
      << "  rate_hz: " << digits(imu.rate_hz) << "\n"
      << "  gyro_noise_density: " << digits(imu.gyro_noise_density) << "  # rad / s / sqrt(Hz)\n"
      << "  gyro_random_walk: " << digits(imu.gyro_random_walk) << "  # rad / s^2 / sqrt(Hz)\n"
      << "  accel_noise_density: " << digits(imu.accel_noise_density) << "  # m / s^2 / sqrt(Hz)\n"
      << "  accel_random_walk: " << digits(imu.accel_random_walk) << "  # m / s^3 / sqrt(Hz)\n"
      << "  time_shift_s: " << digits(imu.time_shift_s)
      << "  # t_imu = t_camera + time_shift_s; seconds\n";
}

}  // namespace

Calibration parse_calibration(const std::string& text, const std::string& file) {
  const YamlNode root = YamlNode::parse(text, file);
  root.allow_only({"cameras", "T_body_cam0", "T_body_cam1", "imu", "depth"});
  Calibration c;
  const YamlNode cameras =
      root.required("cameras", "a list of one (RGB-D) or two (stereo) cameras");
  for (const YamlNode& item : cameras.items()) c.cameras.push_back(read_camera(item));
  if (c.cameras.empty() || c.cameras.size() > 2)
    cameras.fail("has " + std::to_string(c.cameras.size()) + " cameras",
                 "one (RGB-D) or two (stereo)");
  if (const auto imu = root.find("imu")) c.imu = read_imu(*imu);
  if (const auto depth = root.find("depth")) c.depth = read_depth(*depth);

  // Without an IMU the body may be the first camera itself; every other pose must be stated.
  if (c.imu || root.has("T_body_cam0"))
    c.cameras[0].T_body_camera =
        root.required("T_body_cam0", "16 numbers, row by row: camera in the IMU frame").transform();
  if (c.cameras.size() == 2) {
    c.cameras[1].T_body_camera =
        root.required("T_body_cam1", "16 numbers, row by row: camera in the body frame")
            .transform();
  } else if (const auto extra = root.find("T_body_cam1")) {
    extra->fail("is given but there is only one camera");
  }
  try {
    c.validate();
  } catch (const InvalidArgument& e) {
    throw InputError(in_file(file), e.what());
  }
  return c;
}

Calibration load_calibration(const std::filesystem::path& path) {
  return parse_calibration(read_text_file(path), path.string());
}

std::string to_yaml(const Calibration& c) {
  c.validate();
  std::ostringstream out;
  out << "# fastloop calibration. Body frame: "
      << (c.imu ? "the IMU" : "see T_body_cam0 (identity: cam0)")
      << ".\n# Camera frame: x right, y down, z forward; pixel (0, 0) is the centre of the upper "
         "left pixel.\n\n"
      << "cameras:\n";
  for (const CameraCalibration& camera : c.cameras) write_camera(out, camera);
  out << "\n";
  for (std::size_t i = 0; i < c.cameras.size(); ++i)
    write_transform(out, "T_body_cam" + std::to_string(i), c.cameras[i].T_body_camera);
  if (c.imu) write_imu(out, *c.imu);
  if (c.depth)
    out << "\ndepth:\n"
        << "  units_per_metre: " << digits(c.depth->units_per_metre)
        << "  # stored value of one metre\n"
        << "  virtual_baseline_m: " << digits(c.depth->virtual_baseline_m)
        << "  # of the virtual right camera; metres\n"
        << "  max_depth_m: " << digits(c.depth->max_depth_m)
        << "  # farther values are not used; metres\n";
  return out.str();
}

void save_calibration(const std::filesystem::path& path, const Calibration& calibration) {
  write_text_file(path, to_yaml(calibration));
}

}  // namespace fastloop::io
