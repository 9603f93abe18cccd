#include <ceres/version.h>
#include <tbb/info.h>
#include <tbb/version.h>

#include <Eigen/Core>
#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <memory>
#include <opencv2/core/version.hpp>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "commands.hpp"
#include "doctor_cuda.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/io/dataset.hpp"
#include "machine.hpp"

namespace fastloop::apps {
namespace {

namespace fs = std::filesystem;

void print_row(const char* name, const std::string& value) {
  std::printf("%-14s %s\n", name, value.c_str());
}

std::string fixed(double value, int decimals) {
  std::ostringstream out;
  out.setf(std::ios::fixed);
  out.precision(decimals);
  out << value;
  return out.str();
}

/// The instruction sets that matter here, among those the CPU names.
std::string simd() {
  std::istringstream flags(proc_value("/proc/cpuinfo", "flags") + " " +
                           proc_value("/proc/cpuinfo", "Features"));
  static const std::vector<std::string> kKnown{
      "sse4_2", "popcnt",          "avx", "avx2", "fma", "bmi2", "avx512f", "avx512bw", "asimd",
      "sve",    "avx512_vpopcntdq"};
  std::string found;
  for (std::string flag; flags >> flag;)
    if (std::find(kKnown.begin(), kKnown.end(), flag) != kKnown.end()) found += flag + " ";
  return found.empty() ? "unknown" : found;
}

std::string gibibytes(const char* key) {
  std::istringstream value(proc_value("/proc/meminfo", key));
  double kibibytes = 0;
  return value >> kibibytes ? fixed(kibibytes / (1024.0 * 1024.0), 1) + " GiB" : "unknown";
}

void print_versions() {
  print_row("fastloop", std::string(FASTLOOP_VERSION) + " (" + FASTLOOP_BUILD_TYPE + ")");
  print_row("compiler", FASTLOOP_COMPILER);
  print_row("Eigen", std::to_string(EIGEN_WORLD_VERSION) + "." +
                         std::to_string(EIGEN_MAJOR_VERSION) + "." +
                         std::to_string(EIGEN_MINOR_VERSION));
  print_row("OpenCV", CV_VERSION);
  print_row("Ceres", CERES_VERSION_STRING);
  print_row("oneTBB", TBB_runtime_version());
}

void print_machine() {
  const std::string model = proc_value("/proc/cpuinfo", "model name");
  print_row("CPU", model.empty() ? "unknown" : model);
  print_row("cores", std::to_string(std::thread::hardware_concurrency()) + ", worker threads " +
                         std::to_string(tbb::info::default_concurrency()));
  print_row("SIMD", simd());
  print_row("memory", gibibytes("MemTotal") + ", available " + gibibytes("MemAvailable"));
}

/// Tries to write in the folder, or, when it does not exist yet, in the nearest parent that does.
bool check_writable(const std::string& folder) {
  std::error_code ec;
  fs::path existing = fs::absolute(folder, ec);
  while (!fs::exists(existing, ec) && existing.has_relative_path())
    existing = existing.parent_path();
  const fs::path probe = existing / ".fastloop_doctor_probe";
  std::ofstream out(probe);
  out << "probe\n";
  out.close();
  const bool writable = static_cast<bool>(out);
  fs::remove(probe, ec);
  if (!writable) {
    print_row("output", folder + ": NOT writable (" + existing.string() + ")");
    return false;
  }
  const auto space = fs::space(existing, ec);
  print_row("output", folder + ": writable, " +
                          fixed(static_cast<double>(space.available) / (1 << 30), 1) + " GiB free");
  return true;
}

std::string describe(const CameraCalibration& camera) {
  std::ostringstream out;
  const Vector3d& t = camera.T_body_camera.translation;
  out << (camera.camera.model == CameraModel::kPinhole ? "pinhole " : "Kannala-Brandt fisheye ")
      << camera.camera.width << " x " << camera.camera.height << ", fx " << camera.camera.fx << ", "
      << camera.rate_hz << " Hz, at (" << fixed(t.x(), 3) << ", " << fixed(t.y(), 3) << ", "
      << fixed(t.z(), 3) << ") m in the body";
  return out.str();
}

void print_dataset(const std::string& folder, const std::string& calibration_file) {
  io::OpenOptions options;
  if (!calibration_file.empty()) options.calibration = calibration_file;
  const auto dataset = io::open_dataset(folder, options);
  const Nanoseconds first = dataset->stamp_ns(0), last = dataset->stamp_ns(dataset->size() - 1);
  print_row("data set", folder + ": " + dataset->format());
  print_row("frames",
            std::to_string(dataset->size()) + " over " + fixed(to_seconds(last - first), 2) + " s");
  const Calibration& calibration = dataset->calibration();
  for (std::size_t i = 0; i < calibration.cameras.size(); ++i)
    print_row(("cam" + std::to_string(i)).c_str(), describe(calibration.cameras[i]));
  if (calibration.imu)
    print_row("IMU", fixed(calibration.imu->rate_hz, 0) + " Hz, time shift " +
                         fixed(1e3 * calibration.imu->time_shift_s, 3) + " ms");
  if (calibration.depth)
    print_row("depth", fixed(calibration.depth->units_per_metre, 0) + " units a metre");
  const auto truth = dataset->ground_truth();
  print_row("ground truth", truth ? truth->string() : "none");
  for (const std::string& remark : dataset->remarks()) print_row("remark", remark);
}

struct DoctorArguments {
  std::string dataset, calibration, output;
  bool calibrate = false;
};

int run_doctor(const DoctorArguments& arguments) {
  print_versions();
  print_machine();
  if (arguments.calibrate) calibrate_costs();
  print_cuda();
  const bool writable = arguments.output.empty() || check_writable(arguments.output);
  if (!arguments.dataset.empty()) print_dataset(arguments.dataset, arguments.calibration);
  return writable ? kExitOk : kExitBadInput;
}

}  // namespace

void add_doctor_command(CLI::App& app, int& exit_code) {
  auto arguments = std::make_shared<DoctorArguments>();
  CLI::App* command = app.add_subcommand(
      "doctor", "Show versions and the machine; check a data set and an output folder");
  command->add_option("DATASET", arguments->dataset,
                      "Also open this data set and show what is in it");
  command->add_option("--calib", arguments->calibration,
                      "Calibration file that replaces the data set's own");
  command->add_option("--out", arguments->output, "Also check that this folder can be written");
  command->add_flag("--calibrate", arguments->calibrate,
                    "Also measure when the GPU is worth the trip, for --backend auto, and store it");
  command->footer("Example: fastloop doctor V1_01_easy --out results");
  command->callback([arguments, &exit_code] { exit_code = run_doctor(*arguments); });
}

}  // namespace fastloop::apps
