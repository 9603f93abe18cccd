#include "fastloop/io/calibration_import.hpp"

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/text.hpp"
#include "fastloop/io/yaml_node.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

NamedText named_text(const fs::path& path) {
  return {read_text_file(path), path.string()};
}

/// Kalibr writes X-camchain-imucam.yaml and X-imu.yaml; TUM-VI has camchain.yaml and
/// imu_config.yaml.
std::optional<fs::path> imu_file_beside(const fs::path& camchain) {
  const std::string stem = camchain.stem().string();
  const std::size_t mark = stem.find("camchain");
  const std::string prefix = mark == std::string::npos ? "" : stem.substr(0, mark);
  for (const std::string& name :
       {prefix + "imu.yaml", std::string("imu_config.yaml"), std::string("imu.yaml")}) {
    const fs::path candidate = camchain.parent_path() / name;
    if (fs::is_regular_file(candidate)) return candidate;
  }
  return std::nullopt;
}

ImportedCalibration import_euroc(const fs::path& sensor_yaml) {
  // <folder>/cam0/sensor.yaml: the other sensors stand beside cam0.
  const fs::path folder = fs::absolute(sensor_yaml).parent_path().parent_path();
  return read_euroc_sensors(folder);
}

}  // namespace

std::string name_of(CalibrationKind kind) {
  switch (kind) {
    case CalibrationKind::kFastloop:
      return "fastloop";
    case CalibrationKind::kKalibr:
      return "Kalibr camchain";
    case CalibrationKind::kOrbSlam:
      return "ORB-SLAM3 settings";
    case CalibrationKind::kEuroc:
      return "EuRoC sensor.yaml";
  }
  return "";
}

CalibrationKind recognise_calibration(const NamedText& yaml) {
  const YamlNode root = YamlNode::parse(yaml.text, yaml.file);
  if (root.has("cam0") || root.has("cam1")) return CalibrationKind::kKalibr;
  if (root.has("T_BS") || root.has("sensor_type")) return CalibrationKind::kEuroc;
  for (const char* key : {"Camera.type", "Camera1.fx", "Camera.fx"})
    if (root.has(key)) return CalibrationKind::kOrbSlam;
  for (const std::string& key : root.keys())
    if (key == "cameras" || key == "imu" || key == "depth" || key.rfind("T_body_cam", 0) == 0)
      return CalibrationKind::kFastloop;
  throw InputError(in_file(yaml.file), "is not a known calibration",
                   "fastloop (cameras: ...), Kalibr camchain (cam0: ...), ORB-SLAM3 settings "
                   "(Camera1.fx: ...) or EuRoC sensor.yaml (T_BS: ...)");
}

ImportedCalibration import_calibration(const fs::path& path,
                                       const std::optional<fs::path>& imu_file) {
  if (fs::is_directory(path)) {
    const fs::path mav = path / "mav0";
    return read_euroc_sensors(fs::is_directory(mav) ? mav : path);
  }
  const NamedText text = named_text(path);
  const CalibrationKind kind = recognise_calibration(text);
  if (imu_file && kind != CalibrationKind::kKalibr)
    throw InputError(in_file(*imu_file), "an IMU file goes with a Kalibr camchain only, but " +
                                             path.string() + " is: " + name_of(kind));
  switch (kind) {
    case CalibrationKind::kKalibr: {
      const auto imu = imu_file ? imu_file : imu_file_beside(path);
      return parse_kalibr(text, imu ? std::optional(named_text(*imu)) : std::nullopt);
    }
    case CalibrationKind::kOrbSlam:
      return parse_orb_slam(text);
    case CalibrationKind::kEuroc:
      return import_euroc(path);
    case CalibrationKind::kFastloop:
      break;
  }
  ImportedCalibration result;
  result.calibration = parse_calibration(text.text, text.file);
  return result;
}

ImportedCalibration read_euroc_sensors(const fs::path& folder) {
  std::vector<NamedText> cameras;
  for (const char* name : {"cam0", "cam1"})
    cameras.push_back(named_text(folder / name / "sensor.yaml"));
  const fs::path imu = folder / "imu0" / "sensor.yaml";
  return parse_euroc_sensors(cameras,
                             fs::exists(imu) ? std::optional(named_text(imu)) : std::nullopt);
}

}  // namespace fastloop::io
