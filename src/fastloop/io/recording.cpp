#include "fastloop/io/recording.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/io/frame_pairing.hpp"
#include "fastloop/io/image_file.hpp"
#include "fastloop/io/imu_recording.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

std::string size_text(int width, int height) {
  return std::to_string(width) + "x" + std::to_string(height);
}

template <class T>
void check_size(const Image<T>& image, const Camera& camera, const std::filesystem::path& path) {
  if (image.width != camera.width || image.height != camera.height)
    throw InputError(in_file(path), "is " + size_text(image.width, image.height) + " pixels",
                     size_text(camera.width, camera.height) + " as in the calibration");
}

class RecordedDataset : public Dataset {
 public:
  RecordedDataset(Recording recording, int significant_bits)
      : recording_(std::move(recording)), significant_bits_(significant_bits) {}

  std::string format() const override { return recording_.format; }
  const Calibration& calibration() const override { return recording_.calibration; }
  std::size_t size() const override { return recording_.frames.size(); }
  Nanoseconds stamp_ns(std::size_t frame) const override { return at(frame).stamp_ns; }
  std::optional<std::filesystem::path> ground_truth() const override {
    return recording_.ground_truth;
  }
  const std::vector<std::string>& remarks() const override { return recording_.remarks; }

  std::vector<ImuSample> imu_between(Nanoseconds begin_ns, Nanoseconds end_ns) const override {
    const auto samples = imu_covering(recording_.imu, begin_ns, end_ns);
    return {samples.begin(), samples.end()};
  }

  FrameInput load(std::size_t frame) const override {
    const RecordedFrame& files = at(frame);
    const Calibration& c = recording_.calibration;
    FrameInput input;
    input.stamp_ns = files.stamp_ns;
    input.left = read_grey_image(files.left, significant_bits_);
    check_size(input.left, c.cameras[0].camera, files.left);
    if (c.depth) {
      input.depth = read_depth_image(files.second, c.depth->units_per_metre);
      check_size(input.depth, c.cameras[0].camera, files.second);
    } else {
      input.right = read_grey_image(files.second, significant_bits_);
      check_size(input.right, c.cameras[1].camera, files.second);
    }
    const Nanoseconds previous = frame > 0 ? at(frame - 1).stamp_ns : files.stamp_ns;
    input.imu = imu_between(previous, files.stamp_ns);
    return input;
  }

 private:
  const RecordedFrame& at(std::size_t frame) const {
    if (frame >= recording_.frames.size())
      throw InvalidArgument("frame " + std::to_string(frame) + " of " +
                            std::to_string(recording_.frames.size()));
    return recording_.frames[frame];
  }

  Recording recording_;
  int significant_bits_;
};

std::vector<Nanoseconds> frame_stamps(const Recording& recording) {
  std::vector<Nanoseconds> stamps;
  for (const RecordedFrame& frame : recording.frames) stamps.push_back(frame.stamp_ns);
  return stamps;
}

void measure_camera_rate(Recording& recording) {
  const Nanoseconds gap = median_gap_ns(frame_stamps(recording));
  if (recording.camera_rate_known || gap <= 0) return;
  for (CameraCalibration& camera : recording.calibration.cameras)
    camera.rate_hz = 1.0 / to_seconds(gap);
}

/// 16-bit cameras often fill 10 or 12 bits only. A few frames over the sequence tell.
int sequence_significant_bits(Recording& recording) {
  const std::size_t count = recording.frames.size();
  int bits = count_significant_bits(recording.frames[0].left);
  if (bits == 8) return 16;
  constexpr std::size_t kProbes = 8;
  for (std::size_t i = 1; i < kProbes && bits < 16; ++i)
    bits = std::max(bits,
                    count_significant_bits(recording.frames[i * (count - 1) / (kProbes - 1)].left));
  if (bits < 16)
    recording.remarks.push_back("16-bit images use " + std::to_string(bits) +
                                " bits only; scaled to 8 bits accordingly");
  return bits;
}

/// Frames that the IMU does not cover cannot be predicted; the user should know.
void remark_uncovered_frames(Recording& recording) {
  if (recording.imu.empty()) return;
  const Nanoseconds first = recording.imu.front().stamp_ns, last = recording.imu.back().stamp_ns;
  const auto before = std::count_if(recording.frames.begin(), recording.frames.end(),
                                    [&](const RecordedFrame& f) { return f.stamp_ns < first; });
  const auto after = std::count_if(recording.frames.begin(), recording.frames.end(),
                                   [&](const RecordedFrame& f) { return f.stamp_ns > last; });
  if (before > 0)
    recording.remarks.push_back(std::to_string(before) + " frame(s) before the first IMU sample");
  if (after > 0)
    recording.remarks.push_back(std::to_string(after) + " frame(s) after the last IMU sample");
}

}  // namespace

std::unique_ptr<Dataset> make_dataset(Recording recording, const std::filesystem::path& folder) {
  if (recording.frames.empty())
    throw InputError(in_file(folder), "no frame has all of its images",
                     "images with stamps that agree between the cameras");
  const auto repeated = std::adjacent_find(
      recording.frames.begin(), recording.frames.end(),
      [](const RecordedFrame& a, const RecordedFrame& b) { return a.stamp_ns >= b.stamp_ns; });
  if (repeated != recording.frames.end())
    throw InputError(in_file(folder),
                     "frame stamps do not increase after " + std::to_string(repeated->stamp_ns));
  measure_camera_rate(recording);
  try {
    recording.calibration.validate();
  } catch (const InvalidArgument& e) {
    throw InputError(in_file(folder), e.what());
  }
  remark_uncovered_frames(recording);
  const int bits = sequence_significant_bits(recording);
  auto dataset = std::make_unique<RecordedDataset>(std::move(recording), bits);
  dataset->load(
      0);  // a calibration of another image size is found now and not in the middle of a run
  return dataset;
}

}  // namespace fastloop::io
