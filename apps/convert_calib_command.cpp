#include <iostream>
#include <memory>
#include <optional>
#include <string>

#include "commands.hpp"
#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/calibration_report.hpp"
#include "fastloop/io/calibration_yaml.hpp"

namespace fastloop::apps {
namespace {

struct ConvertCalibArguments {
  std::string input, imu, output;
};

void convert_calibration(const ConvertCalibArguments& arguments) {
  std::optional<std::filesystem::path> imu;
  if (!arguments.imu.empty()) imu = arguments.imu;
  const io::ImportedCalibration imported = io::import_calibration(arguments.input, imu);
  io::save_calibration(arguments.output, imported.calibration);
  std::cout << "read          " << arguments.input << " (" << io::name_of(imported.kind) << ")\n"
            << io::describe_calibration(imported.calibration);
  for (const std::string& remark : imported.remarks)
    std::cout << "remark        " << remark << "\n";
  if (!imported.camera_rate_known)
    std::cout << "remark        the camera rate is not stated: "
              << imported.calibration.cameras[0].rate_hz
              << " Hz is written, correct rate_hz if it is wrong\n";
  std::cout << "wrote         " << arguments.output << "\n";
}

}  // namespace

void add_convert_calib_command(CLI::App& app, int& exit_code) {
  auto arguments = std::make_shared<ConvertCalibArguments>();
  CLI::App* command = app.add_subcommand(
      "convert-calib",
      "Convert a calibration to fastloop's own YAML and print what it says.\n"
      "Reads Kalibr camchain files, ORB-SLAM3 settings, EuRoC folders or sensor.yaml, and "
      "fastloop's own.\n"
      "Example: fastloop convert-calib camchain-imucam.yaml --imu imu.yaml --out rig.yaml");
  command
      ->add_option("input", arguments->input, "Calibration file, or a folder with cam0/sensor.yaml")
      ->required();
  command->add_option(
      "--imu", arguments->imu,
      "IMU noise file of a Kalibr calibration (default: the one beside the camchain)");
  command->add_option("-o,--out", arguments->output, "File to write")->required();
  command->callback([arguments, &exit_code] {
    convert_calibration(*arguments);
    exit_code = kExitOk;
  });
}

}  // namespace fastloop::apps
