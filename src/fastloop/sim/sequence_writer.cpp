#include "fastloop/sim/sequence_writer.hpp"

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <array>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <mutex>
#include <opencv2/imgcodecs.hpp>
#include <system_error>

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/text.hpp"
#include "fastloop/io/trajectory.hpp"

namespace fastloop::sim {
namespace fs = std::filesystem;
namespace {

constexpr const char* kMarker = "simulation.txt";  ///< tells a simulated folder from anything else
constexpr double kGroundTruthHz = 200;

template <class... Values>
std::string format(const char* pattern, Values... values) {
  std::array<char, 1024> buffer;
  const int n = std::snprintf(buffer.data(), buffer.size(), pattern, values...);
  return std::string(buffer.data(), static_cast<std::size_t>(std::max(n, 0)));
}

std::string stamp_text(Nanoseconds t) { return std::to_string(t); }

/// TUM layout: seconds with six decimals.
std::string seconds_text(Nanoseconds t) {
  return format("%lld.%06lld", static_cast<long long>(t / 1'000'000'000),
                static_cast<long long>(t % 1'000'000'000 / 1000));
}

void make_folder(const fs::path& folder) {
  std::error_code error;
  fs::create_directories(folder, error);
  if (error || !fs::is_directory(folder))
    throw InputError({folder.string(), 0, ""}, "cannot create the folder: " + error.message(), "a writable folder");
}

void write_png(const fs::path& file, const cv::Mat& image) {
  std::vector<unsigned char> bytes;
  if (!cv::imencode(".png", image, bytes, {cv::IMWRITE_PNG_COMPRESSION, 1}))
    throw InputError({file.string(), 0, ""}, "the image could not be encoded");
  write_bytes(file, bytes.data(), bytes.size());
}

void write_grey(const fs::path& file, const ImageU8& image) {
  write_png(file, cv::Mat(image.height, image.width, CV_8UC1, const_cast<std::uint8_t*>(image.pixels.data())));
}

void write_depth(const fs::path& file, const ImageF32& depth, double units_per_metre) {
  cv::Mat stored(depth.height, depth.width, CV_16UC1);
  for (int y = 0; y < depth.height; ++y)
    for (int x = 0; x < depth.width; ++x)
      stored.at<std::uint16_t>(y, x) =
          static_cast<std::uint16_t>(std::lround(std::min(depth.at(x, y) * units_per_metre, 65535.0)));
  write_png(file, stored);
}

std::string pose_rows(const SE3& T) {
  const Eigen::Matrix4d m = T.matrix();
  std::string text = "T_BS:\n  cols: 4\n  rows: 4\n  data: [";
  for (int r = 0; r < 4; ++r)
    text += format("%.15g, %.15g, %.15g, %.15g%s", m(r, 0), m(r, 1), m(r, 2), m(r, 3), r < 3 ? ",\n         " : "]\n");
  return text;
}

std::string camera_yaml(const CameraCalibration& c, int index) {
  const Camera& k = c.camera;
  const bool fisheye = k.model == CameraModel::kKannalaBrandt;
  return format("%%YAML:1.0\nsensor_type: camera\ncomment: simulated cam%d\n\n", index) + pose_rows(c.T_body_camera) +
         format("\nrate_hz: %g\nresolution: [%d, %d]\ncamera_model: pinhole\n", c.rate_hz, k.width, k.height) +
         format("intrinsics: [%.17g, %.17g, %.17g, %.17g] #fu, fv, cu, cv\n", k.fx, k.fy, k.cx, k.cy) +
         format("distortion_model: %s\n", fisheye ? "equidistant" : "radial-tangential") +
         format("distortion_coefficients: [%.17g, %.17g, %.17g, %.17g]\n", k.distortion[0], k.distortion[1],
                k.distortion[2], k.distortion[3]);
}

std::string imu_yaml(const ImuCalibration& imu) {
  return "%YAML:1.0\nsensor_type: imu\ncomment: simulated IMU\n\n" + pose_rows(SE3()) +
         format("\nrate_hz: %g\n", imu.rate_hz) +
         format("gyroscope_noise_density: %.9g     # rad / s / sqrt(Hz)\n", imu.gyro_noise_density) +
         format("gyroscope_random_walk: %.9g       # rad / s^2 / sqrt(Hz)\n", imu.gyro_random_walk) +
         format("accelerometer_noise_density: %.9g # m / s^2 / sqrt(Hz)\n", imu.accel_noise_density) +
         format("accelerometer_random_walk: %.9g   # m / s^3 / sqrt(Hz)\n", imu.accel_random_walk);
}

std::string imu_csv(const std::vector<ImuSample>& samples) {
  std::string text =
      "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
      "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n";
  for (const ImuSample& s : samples)
    text += stamp_text(s.stamp_ns) + format(",%.10f,%.10f,%.10f,%.10f,%.10f,%.10f\n", s.gyro.x(), s.gyro.y(),
                                            s.gyro.z(), s.accel.x(), s.accel.y(), s.accel.z());
  return text;
}

std::string ground_truth_csv(const SimulatedSequence& sequence) {
  std::string text =
      "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
      "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
      "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n";
  const Nanoseconds first = sequence.stamp_ns(0), last = sequence.stamp_ns(sequence.size() - 1);
  const Nanoseconds period = from_seconds(1.0 / kGroundTruthHz);
  for (Nanoseconds t = first; t <= last; t += period) {
    const NavState x = sequence.ground_truth(t);
    const Eigen::Quaterniond& q = x.T_world_body.rotation;
    const double sign = q.w() < 0 ? -1 : 1;
    text += stamp_text(t) + format(",%.9f,%.9f,%.9f", x.T_world_body.translation.x(),
                                   x.T_world_body.translation.y(), x.T_world_body.translation.z());
    text += format(",%.10f,%.10f,%.10f,%.10f", sign * q.w(), sign * q.x(), sign * q.y(), sign * q.z());
    for (const Vector3d& v : {x.v_world, x.bias.gyro, x.bias.accel})
      text += format(",%.9f,%.9f,%.9f", v.x(), v.y(), v.z());
    text += "\n";
  }
  return text;
}

/// Paths of the images of frame `index`, relative to the folder.
struct FrameFiles {
  fs::path first, second;
};

FrameFiles frame_files(const SimulatedSequence& sequence, std::size_t index) {
  const Nanoseconds t = sequence.stamp_ns(index);
  if (sequence.calibration().depth)
    return {fs::path("rgb") / (seconds_text(t) + ".png"), fs::path("depth") / (seconds_text(t) + ".png")};
  const std::string name = stamp_text(t) + ".png";
  return {fs::path("mav0/cam0/data") / name, fs::path("mav0/cam1/data") / name};
}

void write_frame(const SimulatedSequence& sequence, std::size_t index, const fs::path& folder) {
  const FrameFiles files = frame_files(sequence, index);
  ImageF32 depth;
  const auto& depth_calibration = sequence.calibration().depth;
  write_grey(folder / files.first, sequence.image(index, 0, depth_calibration ? &depth : nullptr));
  if (depth_calibration)
    write_depth(folder / files.second, depth, depth_calibration->units_per_metre);
  else
    write_grey(folder / files.second, sequence.image(index, 1));
}

void write_euroc_tables(const SimulatedSequence& sequence, const fs::path& folder) {
  const Calibration& calibration = sequence.calibration();
  std::string list = "#timestamp [ns],filename\n";
  for (std::size_t i = 0; i < sequence.size(); ++i)
    list += stamp_text(sequence.stamp_ns(i)) + "," + stamp_text(sequence.stamp_ns(i)) + ".png\n";
  const fs::path mav = folder / "mav0";
  for (int c = 0; c < 2; ++c) {
    const fs::path camera = mav / ("cam" + std::to_string(c));
    io::write_text_file(camera / "data.csv", list);
    io::write_text_file(camera / "sensor.yaml", camera_yaml(calibration.cameras[c], c));
  }
  io::write_text_file(mav / "imu0/data.csv", imu_csv(sequence.imu()));
  io::write_text_file(mav / "imu0/sensor.yaml", imu_yaml(*calibration.imu));
  const fs::path truth = mav / "state_groundtruth_estimate0";
  io::write_text_file(truth / "data.csv", ground_truth_csv(sequence));
  io::write_text_file(truth / "sensor.yaml",
                      "%YAML:1.0\nsensor_type: visual-inertial\ncomment: exact state of the simulated body\n\n" +
                          pose_rows(SE3()));
  io::write_text_file(mav / "body.yaml", "comment: simulated device\n");
}

void write_rgbd_tables(const SimulatedSequence& sequence, const fs::path& folder) {
  std::string rgb = "# timestamp filename\n", depth = rgb, both;
  std::vector<io::StampedPose> truth;
  for (std::size_t i = 0; i < sequence.size(); ++i) {
    const std::string t = seconds_text(sequence.stamp_ns(i));
    const FrameFiles files = frame_files(sequence, i);
    rgb += t + " " + files.first.string() + "\n";
    depth += t + " " + files.second.string() + "\n";
    both += t + " " + files.first.string() + " " + t + " " + files.second.string() + "\n";
    truth.push_back({sequence.stamp_ns(i), sequence.ground_truth(sequence.stamp_ns(i)).T_world_body *
                                               sequence.calibration().cameras[0].T_body_camera});
  }
  io::write_text_file(folder / "rgb.txt", rgb);
  io::write_text_file(folder / "depth.txt", depth);
  io::write_text_file(folder / "associations.txt", both);
  io::write_tum(folder / "groundtruth.txt", truth);
  io::save_calibration(folder / "calibration.yaml", sequence.calibration());
}

/// Empties a folder of an earlier simulation; refuses to touch anything else.
void prepare_folder(const fs::path& folder) {
  std::error_code error;
  if (fs::exists(folder, error) && !fs::is_directory(folder))
    throw InputError({folder.string(), 0, ""}, "is not a folder", "a folder to write to");
  make_folder(folder);
  if (fs::is_empty(folder, error)) return;
  if (!fs::exists(folder / kMarker, error))
    throw InputError({folder.string(), 0, ""}, "the folder holds files that are not an earlier simulation",
                     "an empty or new folder");
  for (const char* old : {"mav0", "rgb", "depth"}) fs::remove_all(folder / old, error);
  for (const char* old : {"rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt", "calibration.yaml"})
    fs::remove(folder / old, error);
}

void check_space(const SimulatedSequence& sequence, const fs::path& folder) {
  double bytes = 4e6;  // tables
  for (const CameraCalibration& c : sequence.calibration().cameras)
    bytes += 0.8 * c.camera.width * c.camera.height * static_cast<double>(sequence.size());
  if (sequence.calibration().depth) bytes *= 2.5;
  std::error_code error;
  const fs::space_info space = fs::space(folder, error);
  if (error || static_cast<double>(space.available) > bytes) return;
  throw InputError({folder.string(), 0, ""}, "not enough free disk space",
                   format("about %.0f MB, free are %.0f MB", bytes / 1e6, static_cast<double>(space.available) / 1e6));
}

std::string description(const SequenceOptions& options) {
  return "A sequence made by `fastloop simulate`. Writing another one here replaces it.\n" +
         format("world %s\ncamera %s\nseconds %g\nseed %llu\nmotion %s\n", to_string(options.world).c_str(),
                to_string(options.camera).c_str(), options.seconds, static_cast<unsigned long long>(options.seed),
                options.motion ? "recorded" : "synthetic");
}

}  // namespace

void write_bytes(const fs::path& file, const void* data, std::size_t size) {
  std::ofstream out(file, std::ios::binary | std::ios::trunc);
  out.write(static_cast<const char*>(data), static_cast<std::streamsize>(size));
  out.close();
  if (!out) throw InputError({file.string(), 0, ""}, "cannot be written completely", "a writable place with free space");
}

void write_sequence(const SimulatedSequence& sequence, const WriteOptions& options) {
  if (options.threads < 0) throw InvalidArgument("threads must not be negative");
  const fs::path& folder = options.folder;
  const bool rgbd = sequence.calibration().depth.has_value();
  if (!rgbd && (sequence.calibration().cameras.size() != 2 || !sequence.calibration().imu))
    throw InvalidArgument("only stereo-inertial and RGB-D sequences can be written");
  prepare_folder(folder);
  check_space(sequence, folder);
  io::write_text_file(folder / kMarker, description(sequence.options()));
  if (rgbd) {
    for (const char* sub : {"rgb", "depth"}) make_folder(folder / sub);
  } else {
    for (const char* sub : {"cam0/data", "cam1/data", "imu0", "state_groundtruth_estimate0"})
      make_folder(folder / "mav0" / sub);
  }
  std::mutex mutex;
  std::size_t done = 0;
  tbb::task_arena arena(options.threads > 0 ? options.threads : tbb::task_arena::automatic);
  arena.execute([&] {
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, sequence.size(), 1),
                      [&](const tbb::blocked_range<std::size_t>& r) {
                        for (std::size_t i = r.begin(); i < r.end(); ++i) {
                          write_frame(sequence, i, folder);
                          const std::lock_guard lock(mutex);
                          ++done;
                          if (options.progress) options.progress(done, sequence.size());
                        }
                      },
                      tbb::simple_partitioner());
  });
  rgbd ? write_rgbd_tables(sequence, folder) : write_euroc_tables(sequence, folder);
}

}  // namespace fastloop::sim
