#include <cstdio>

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/dataset_layouts.hpp"
#include "fastloop/io/image_file.hpp"
#include "fastloop/io/kitti_calibration.hpp"
#include "fastloop/io/recording.hpp"
#include "fastloop/io/sensor_csv.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

/// Grey cameras 0 and 1, or colour cameras 2 and 3.
std::optional<int> find_left_camera(const fs::path& folder) {
  for (const int left : {0, 2})
    if (fs::is_directory(folder / ("image_" + std::to_string(left))) &&
        fs::is_directory(folder / ("image_" + std::to_string(left + 1))))
      return left;
  return std::nullopt;
}

std::string image_name(std::size_t index) {
  char name[32];
  std::snprintf(name, sizeof name, "%06zu.png", index);
  return name;
}

std::vector<RecordedFrame> read_frames(const fs::path& folder, int left_camera,
                                       std::vector<std::string>& remarks) {
  const ImageFolder left(folder / ("image_" + std::to_string(left_camera)));
  const ImageFolder right(folder / ("image_" + std::to_string(left_camera + 1)));
  const fs::path times_file = folder / "times.txt";
  const auto times = parse_times(read_text_file(times_file), times_file.string());
  std::vector<RecordedFrame> frames;
  std::size_t missing = 0, unordered = 0;
  for (std::size_t i = 0; i < times.size(); ++i) {
    auto l = left.find(image_name(i)), r = right.find(image_name(i));
    if (!l || !r) {
      ++missing;
    } else if (!frames.empty() && times[i] <= frames.back().stamp_ns) {
      ++unordered;
    } else {
      frames.push_back({times[i], std::move(*l), std::move(*r)});
    }
  }
  if (missing > 0)
    remarks.push_back(std::to_string(missing) +
                      " frame(s) of times.txt without both images dropped");
  if (unordered > 0)
    remarks.push_back(std::to_string(unordered) + " frame(s) dropped whose time does not increase");
  const std::size_t untimed =
      left.names().size() > times.size() ? left.names().size() - times.size() : 0;
  if (untimed > 0)
    remarks.push_back(std::to_string(untimed) + " image(s) without a line in times.txt dropped");
  if (frames.empty())
    throw InputError(in_file(times_file), "no line has both of its images",
                     "images such as " + (left.path() / "000000.png").string());
  return frames;
}

std::optional<fs::path> find_ground_truth(const fs::path& folder) {
  const fs::path absolute = fs::absolute(folder / "times.txt").parent_path();
  const std::string sequence = absolute.filename().string() + ".txt";
  return first_existing({folder / "poses.txt", folder / "groundtruth.txt", folder / sequence,
                         absolute.parent_path().parent_path() / "poses" / sequence});
}

}  // namespace

bool looks_like_kitti(const fs::path& folder) {
  return fs::exists(folder / "times.txt") && find_left_camera(folder).has_value();
}

std::unique_ptr<Dataset> open_kitti(const fs::path& folder, const OpenOptions& options) {
  const int left_camera = find_left_camera(folder).value_or(0);
  Recording recording;
  recording.format = "kitti";
  recording.frames = read_frames(folder, left_camera, recording.remarks);
  if (options.calibration) {
    ImportedCalibration imported = import_calibration(*options.calibration);
    recording.calibration = std::move(imported.calibration);
    recording.calibration.imu.reset();
    recording.camera_rate_known = imported.camera_rate_known;
    if (recording.calibration.cameras.size() != 2)
      throw InputError(in_file(*options.calibration), "has one camera", "two cameras");
  } else {
    const fs::path file = folder / "calib.txt";
    const ImageU8 image = read_grey_image(recording.frames[0].left);
    recording.calibration = parse_kitti_calibration(read_text_file(file), file.string(),
                                                    left_camera, image.width, image.height);
    recording.camera_rate_known = false;
  }
  recording.remarks.push_back(
      "KITTI odometry has no IMU: the body frame is that of the left camera");
  recording.ground_truth = find_ground_truth(folder);
  return make_dataset(std::move(recording), folder);
}

}  // namespace fastloop::io
