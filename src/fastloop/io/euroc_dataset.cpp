#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/dataset_layouts.hpp"
#include "fastloop/io/frame_pairing.hpp"
#include "fastloop/io/imu_recording.hpp"
#include "fastloop/io/recording.hpp"
#include "fastloop/io/sensor_csv.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

constexpr Nanoseconds kMaxStereoOffsetNs = 5'000'000;

struct ImageStream {
  std::vector<Nanoseconds> stamps;
  std::vector<fs::path> paths;
};

/// Without a data.csv the file names are the stamps.
std::vector<StampedFile> stamps_from_names(const ImageFolder& images) {
  std::vector<StampedFile> rows;
  for (const std::string& name : images.names())
    if (const auto stamp = parse_nanoseconds(fs::path(name).stem().string()))
      rows.push_back({*stamp, name});
  if (rows.empty())
    throw InputError(in_file(images.path()),
                     "there is no data.csv and no image is named by its time stamp",
                     "file names such as 1403715273262142976.png");
  return rows;
}

ImageStream read_camera(const fs::path& camera, std::vector<std::string>& remarks) {
  if (!fs::is_directory(camera))
    throw InputError(in_file(camera), "does not exist",
                     "the images of a stereo pair in cam0 and cam1");
  const std::string name = camera.filename().string();
  const ImageFolder images(camera / "data");
  const fs::path csv = camera / "data.csv";
  std::vector<StampedFile> rows;
  if (fs::exists(csv)) {
    rows = parse_image_csv(read_text_file(csv), csv.string());
    if (rows.empty())
      throw InputError(in_file(csv), "lists no images",
                       "lines such as 1403715273262142976,1403715273262142976.png");
  } else {
    rows = stamps_from_names(images);
    remarks.push_back(name + ": no data.csv; the " + std::to_string(rows.size()) +
                      " images are taken by the stamps in their names");
  }
  const std::string repaired = order_by_stamp(rows).description();
  if (!repaired.empty()) remarks.push_back(name + "/data.csv: " + repaired);

  ImageStream stream;
  for (const StampedFile& row : rows)
    if (auto path = images.find(row.name)) {
      stream.stamps.push_back(row.stamp_ns);
      stream.paths.push_back(std::move(*path));
    }
  const std::size_t missing = rows.size() - stream.stamps.size();
  if (stream.stamps.empty())
    throw InputError(in_file(csv), "none of the " + std::to_string(rows.size()) +
                                       " listed images exists in " + images.path().string());
  if (missing > 0)
    remarks.push_back(name + ": " + std::to_string(missing) +
                      " listed image(s) do not exist, dropped");
  return stream;
}

std::vector<RecordedFrame> pair_cameras(ImageStream left, ImageStream right,
                                        std::vector<std::string>& remarks) {
  const Nanoseconds tolerance = pairing_tolerance_ns(left.stamps, right.stamps, kMaxStereoOffsetNs);
  std::vector<RecordedFrame> frames;
  for (const IndexPair& pair : pair_by_time(left.stamps, right.stamps, tolerance))
    frames.push_back({left.stamps[pair.left], std::move(left.paths[pair.left]),
                      std::move(right.paths[pair.right])});
  const auto remark = [&](const char* name, std::size_t count) {
    if (count > frames.size())
      remarks.push_back(std::string(name) + ": " + std::to_string(count - frames.size()) +
                        " image(s) without partner dropped");
  };
  remark("cam0", left.stamps.size());
  remark("cam1", right.stamps.size());
  return frames;
}

/// A camchain or a calibration.yaml in the folder, as TUM-VI has it.
std::optional<fs::path> find_calibration_file(const fs::path& folder, const fs::path& root) {
  for (const fs::path& place :
       {folder, folder / "dso", root, root.parent_path(), root.parent_path() / "dso"}) {
    if (place.empty() || !fs::is_directory(place)) continue;
    if (fs::exists(place / "calibration.yaml")) return place / "calibration.yaml";
    std::vector<fs::path> chains;
    for (const auto& entry : fs::directory_iterator(place)) {
      const std::string name = entry.path().filename().string();
      if (name.find("camchain") != std::string::npos && entry.path().extension() == ".yaml")
        chains.push_back(entry.path());
    }
    if (!chains.empty())
      return *std::max_element(chains.begin(), chains.end());  // "-imucam" sorts last
  }
  return std::nullopt;
}

ImportedCalibration read_calibration(const fs::path& folder, const fs::path& root,
                                     const OpenOptions& options) {
  if (options.calibration) return import_calibration(*options.calibration);
  if (fs::exists(root / "cam0" / "sensor.yaml")) return read_euroc_sensors(root);
  if (const auto file = find_calibration_file(folder, root)) return import_calibration(*file);
  throw InputError(
      in_file(root / "cam0" / "sensor.yaml"), "there is no calibration",
      "cam0/sensor.yaml and cam1/sensor.yaml, a camchain.yaml or calibration.yaml in the folder, "
      "or a calibration file given with --calib");
}

void read_imu(const fs::path& root, Recording& recording) {
  Calibration& c = recording.calibration;
  const fs::path csv = root / "imu0" / "data.csv";
  if (!fs::exists(csv)) {
    recording.remarks.push_back("no imu0/data.csv: there is no IMU");
    c.imu.reset();
    return;
  }
  if (!c.imu) {
    recording.remarks.push_back("the calibration has no IMU: imu0/data.csv is not used");
    return;
  }
  ImuRecording imu = read_imu_recording(csv, c.imu->time_shift_s);
  recording.remarks.insert(recording.remarks.end(), imu.remarks.begin(), imu.remarks.end());
  if (imu.samples.size() < 2) {
    recording.remarks.push_back("imu0/data.csv holds no samples: there is no IMU");
    c.imu.reset();
    return;
  }
  recording.imu = std::move(imu.samples);
}

std::optional<fs::path> find_ground_truth(const fs::path& folder, const fs::path& root) {
  if (const auto path = first_existing({root / "state_groundtruth_estimate0" / "data.csv",
                                        root / "mocap0" / "data.csv", root / "groundtruth.txt",
                                        folder / "groundtruth.txt"}))
    return path;
  // Corrected ground truth is handed on as <anything>_tum.txt beside mav0.
  for (const auto& entry : fs::directory_iterator(folder)) {
    const std::string name = entry.path().filename().string();
    if (name.size() > 8 && name.substr(name.size() - 8) == "_tum.txt") return entry.path();
  }
  return std::nullopt;
}

}  // namespace

std::optional<fs::path> find_euroc_root(const fs::path& folder) {
  for (const fs::path& root : {folder / "mav0", folder})
    if (fs::is_directory(root / "cam0")) return root;
  return std::nullopt;
}

std::unique_ptr<Dataset> open_euroc(const fs::path& folder, const OpenOptions& options) {
  const fs::path root = find_euroc_root(folder).value_or(folder);
  Recording recording;
  recording.format = fs::exists(root / "mocap0") ? "tum-vi" : "euroc";
  ImageStream left = read_camera(root / "cam0", recording.remarks);
  ImageStream right = read_camera(root / "cam1", recording.remarks);

  ImportedCalibration imported = read_calibration(folder, root, options);
  recording.calibration = std::move(imported.calibration);
  recording.camera_rate_known = imported.camera_rate_known;
  recording.remarks.insert(recording.remarks.end(), imported.remarks.begin(),
                           imported.remarks.end());
  if (recording.calibration.cameras.size() != 2)
    throw InputError(in_file(options.calibration.value_or(folder)),
                     "the calibration has one camera", "two, for cam0 and cam1");

  recording.frames = pair_cameras(std::move(left), std::move(right), recording.remarks);
  read_imu(root, recording);
  recording.ground_truth = find_ground_truth(folder, root);
  return make_dataset(std::move(recording), root);
}

}  // namespace fastloop::io
