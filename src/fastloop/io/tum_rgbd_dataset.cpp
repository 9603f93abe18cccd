#include <algorithm>
#include <cstdio>
#include <vector>

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/dataset_layouts.hpp"
#include "fastloop/io/frame_pairing.hpp"
#include "fastloop/io/image_file.hpp"
#include "fastloop/io/recording.hpp"
#include "fastloop/io/sensor_csv.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

/// Colour and depth of a structured-light camera are triggered apart; TUM's own tool allows 20 ms.
constexpr Nanoseconds kMaxDepthOffsetNs = 20'000'000;

std::optional<fs::path> find_associations(const fs::path& folder) {
  return first_existing(
      {folder / "associations.txt", folder / "associate.txt", folder / "association.txt"});
}

std::vector<StampedFile> read_list(const fs::path& list, std::vector<std::string>& remarks) {
  auto rows = parse_image_list(read_text_file(list), list.string());
  if (rows.empty())
    throw InputError(in_file(list), "lists no images",
                     "lines such as 1305031102.175304 rgb/1305031102.175304.png");
  const std::string repaired = order_by_stamp(rows).description();
  if (!repaired.empty()) remarks.push_back(list.filename().string() + ": " + repaired);
  return rows;
}

std::vector<ImageAssociation> associate(const fs::path& folder, std::vector<std::string>& remarks) {
  const auto colour = read_list(folder / "rgb.txt", remarks);
  const auto depth = read_list(folder / "depth.txt", remarks);
  const auto stamps = [](const std::vector<StampedFile>& rows) {
    std::vector<Nanoseconds> all;
    for (const StampedFile& row : rows) all.push_back(row.stamp_ns);
    return all;
  };
  const auto colour_stamps = stamps(colour), depth_stamps = stamps(depth);
  std::vector<ImageAssociation> rows;
  for (const IndexPair& pair :
       pair_by_time(colour_stamps, depth_stamps,
                    pairing_tolerance_ns(colour_stamps, depth_stamps, kMaxDepthOffsetNs)))
    rows.push_back({colour[pair.left].stamp_ns, colour[pair.left].name, depth[pair.right].name});
  const auto remark = [&](const char* name, std::size_t count) {
    if (count > rows.size())
      remarks.push_back(std::string(name) + ": " + std::to_string(count - rows.size()) +
                        " image(s) without partner dropped");
  };
  remark("rgb.txt", colour.size());
  remark("depth.txt", depth.size());
  return rows;
}

std::vector<RecordedFrame> read_frames(const fs::path& folder, std::vector<std::string>& remarks) {
  std::vector<ImageAssociation> rows;
  if (const auto file = find_associations(folder)) {
    rows = parse_associations(read_text_file(*file), file->string());
    const std::string repaired = order_by_stamp(rows).description();
    if (!repaired.empty()) remarks.push_back(file->filename().string() + ": " + repaired);
    if (rows.empty())
      throw InputError(in_file(*file), "lists no images",
                       "lines: seconds, colour image, seconds, depth image");
  } else {
    rows = associate(folder, remarks);
  }
  std::vector<RecordedFrame> frames;
  std::size_t missing = 0;
  for (const ImageAssociation& row : rows) {
    RecordedFrame frame{row.stamp_ns, folder / row.colour, folder / row.depth};
    if (fs::exists(frame.left) && fs::exists(frame.second)) {
      frames.push_back(std::move(frame));
    } else {
      ++missing;
    }
  }
  if (frames.empty() && !rows.empty())
    throw InputError(in_file(folder / rows[0].colour), "none of the listed images exists",
                     "images in rgb and depth");
  if (missing > 0)
    remarks.push_back(std::to_string(missing) + " listed frame(s) do not exist, dropped");
  return frames;
}

/// Two kinds of uncalibrated Kinect recordings are common: the TUM data sets (5000 units per metre, ROS
/// intrinsics) and Microsoft's (millimetres, 585 pixels, as published with 7-Scenes). The unit tells them
/// apart: in millimetres the median depth of an indoor view stays below what 5000 per metre would make
/// of 0.9 m, the near limit of the sensor's useful range.
Calibration default_kinect(const fs::path& depth_image) {
  std::vector<float> raw;
  for (const float d : read_depth_image(depth_image, 1.0).pixels)
    if (d > 0) raw.push_back(d);
  const auto middle = raw.begin() + static_cast<std::ptrdiff_t>(raw.size() / 2);
  std::nth_element(raw.begin(), middle, raw.end());
  const bool millimetres = !raw.empty() && *middle < 4500;

  Calibration c;
  c.cameras.resize(1);
  Camera& camera = c.cameras[0].camera;
  camera.width = 640, camera.height = 480;
  camera.fx = camera.fy = millimetres ? 585 : 525;
  camera.cx = millimetres ? 320 : 319.5, camera.cy = millimetres ? 240 : 239.5;
  c.depth.emplace().units_per_metre = millimetres ? 1000 : 5000;
  return c;
}

void read_calibration(const fs::path& folder, const OpenOptions& options, Recording& recording) {
  std::optional<fs::path> file = options.calibration;
  if (!file && fs::exists(folder / "calibration.yaml")) file = folder / "calibration.yaml";
  if (file) {
    ImportedCalibration imported = import_calibration(*file);
    recording.calibration = std::move(imported.calibration);
    recording.camera_rate_known = imported.camera_rate_known;
    recording.remarks.insert(recording.remarks.end(), imported.remarks.begin(),
                             imported.remarks.end());
    if (!recording.calibration.depth)
      throw InputError(in_file(*file, 0, "depth"), "is missing: this is a stereo calibration",
                       "one camera and its depth scale");
    if (recording.calibration.imu) {
      recording.calibration.imu.reset();
      recording.remarks.push_back(
          "a TUM RGB-D folder has no IMU: that of the calibration is not used");
    }
    return;
  }
  const ImageU8 image = read_grey_image(recording.frames[0].left);
  if (image.width != 640 || image.height != 480)
    throw InputError(in_file(folder / "calibration.yaml"),
                     "there is no calibration for this RGB-D camera",
                     "a calibration file given with --calib");
  recording.calibration = default_kinect(recording.frames[0].second);
  recording.camera_rate_known = false;
  const Camera& camera = recording.calibration.cameras[0].camera;
  char assumed[160];
  std::snprintf(assumed, sizeof assumed,
                "no calibration: fx = fy = %g, cx = %g, cy = %g, %g depth units per metre are assumed; give the true values with --calib",
                camera.fx, camera.cx, camera.cy, recording.calibration.depth->units_per_metre);
  recording.remarks.push_back(assumed);
}

}  // namespace

bool looks_like_tum_rgbd(const fs::path& folder) {
  return fs::exists(folder / "rgb.txt") || find_associations(folder).has_value();
}

std::unique_ptr<Dataset> open_tum_rgbd(const fs::path& folder, const OpenOptions& options) {
  Recording recording;
  recording.format = "tum-rgbd";
  recording.frames = read_frames(folder, recording.remarks);
  if (recording.frames.empty())
    throw InputError(in_file(folder), "no colour image has a depth image within 20 ms",
                     "matching stamps in rgb.txt and depth.txt");
  read_calibration(folder, options, recording);
  recording.ground_truth = first_existing({folder / "groundtruth.txt"});
  return make_dataset(std::move(recording), folder);
}

}  // namespace fastloop::io
