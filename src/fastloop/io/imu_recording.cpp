#include "fastloop/io/imu_recording.hpp"

#include <algorithm>
#include <cstdio>

#include "fastloop/io/frame_pairing.hpp"
#include "fastloop/io/sensor_csv.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

constexpr int kGapIntervals = 10;
constexpr std::size_t kListedPlaces = 5;  ///< more than that only makes a remark unreadable

std::string seconds_text(double seconds) {
  char buffer[40];
  std::snprintf(buffer, sizeof buffer, "%.3f", seconds);
  return buffer;
}

void remark_not_finite(const std::vector<int>& lines, const std::string& file,
                       std::vector<std::string>& remarks) {
  if (lines.empty()) return;
  std::string list;
  for (std::size_t i = 0; i < std::min(lines.size(), kListedPlaces); ++i)
    list += (i ? ", " : "") + std::to_string(lines[i]);
  if (lines.size() > kListedPlaces) list += ", ...";
  remarks.push_back(file + ": " + std::to_string(lines.size()) +
                    " sample(s) with NaN or infinity dropped (line " + list + ")");
}

void remark_gaps(const ImuRecording& imu, const std::string& file,
                 std::vector<std::string>& remarks) {
  std::vector<Nanoseconds> stamps;
  for (const ImuSample& s : imu.samples) stamps.push_back(s.stamp_ns);
  const Nanoseconds usual = median_gap_ns(stamps);
  std::size_t count = 0;
  std::string list;
  for (std::size_t i = 1; i < stamps.size(); ++i) {
    const Nanoseconds gap = stamps[i] - stamps[i - 1];
    if (gap <= kGapIntervals * usual) continue;
    if (count++ < kListedPlaces)
      list += (list.empty() ? "" : "; ") + seconds_text(to_seconds(gap)) + " s after stamp " +
              std::to_string(stamps[i - 1]) + " (" +
              seconds_text(to_seconds(stamps[i - 1] - stamps[0])) + " s from the start)";
  }
  if (count > kListedPlaces) list += "; ...";
  if (count > 0)
    remarks.push_back(file + ": " + std::to_string(count) + " gap(s) in the IMU: " + list);
}

}  // namespace

ImuRecording parse_imu_recording(std::string_view text, const std::string& file,
                                 double time_shift_s) {
  ImuTable table = parse_imu_csv(text, file);
  ImuRecording imu;
  imu.samples = std::move(table.samples);
  remark_not_finite(table.not_finite, file, imu.remarks);
  const std::string repaired = order_by_stamp(imu.samples).description();
  if (!repaired.empty()) imu.remarks.push_back(file + ": " + repaired);
  const Nanoseconds shift = from_seconds(time_shift_s);
  for (ImuSample& s : imu.samples) s.stamp_ns -= shift;
  remark_gaps(imu, file, imu.remarks);
  return imu;
}

ImuRecording read_imu_recording(const std::filesystem::path& csv, double time_shift_s) {
  return parse_imu_recording(read_text_file(csv), csv.string(), time_shift_s);
}

std::span<const ImuSample> imu_covering(std::span<const ImuSample> samples, Nanoseconds begin_ns,
                                        Nanoseconds end_ns) {
  const auto stamp_after = [](Nanoseconds t, const ImuSample& s) { return t < s.stamp_ns; };
  const auto stamp_before = [](const ImuSample& s, Nanoseconds t) { return s.stamp_ns < t; };
  auto first = std::upper_bound(samples.begin(), samples.end(), begin_ns, stamp_after);
  if (first != samples.begin()) --first;
  auto last = std::lower_bound(first, samples.end(), end_ns, stamp_before);
  if (last != samples.end()) ++last;
  return samples.subspan(static_cast<std::size_t>(first - samples.begin()),
                         static_cast<std::size_t>(last - first));
}

}  // namespace fastloop::io
