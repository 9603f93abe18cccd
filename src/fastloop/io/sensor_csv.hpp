#pragma once

#include <algorithm>
#include <string>
#include <string_view>
#include <vector>

#include "fastloop/core/time.hpp"
#include "fastloop/sensor/imu.hpp"

/// Tables of recorded sequences, parsed from text. `file` is only used in messages.
/// All of them skip blank lines and comments (#), take LF or CRLF line ends, and allow blanks
/// around fields. Rows come back in the order of the file; `order_by_stamp` repairs it.
/// @throws InputError naming file and line of a row that is neither data nor comment
namespace fastloop::io {

struct StampedFile {
  Nanoseconds stamp_ns = 0;
  std::string name;
};

struct ImageAssociation {
  Nanoseconds stamp_ns = 0;  ///< of the colour image
  std::string colour, depth;
};

struct ImuTable {
  std::vector<ImuSample> samples;
  std::vector<int> not_finite;  ///< lines left out because they hold NaN or infinity
};

/// EuRoC camN/data.csv: "nanoseconds,file name".
std::vector<StampedFile> parse_image_csv(std::string_view text, const std::string& file);
/// EuRoC imu0/data.csv: nanoseconds, gyroscope xyz (rad/s), accelerometer xyz (m/s^2).
ImuTable parse_imu_csv(std::string_view text, const std::string& file);
/// TUM RGB-D rgb.txt or depth.txt: "seconds file".
std::vector<StampedFile> parse_image_list(std::string_view text, const std::string& file);
/// TUM RGB-D associations: "seconds colour seconds depth" (recognised when the depth comes first).
std::vector<ImageAssociation> parse_associations(std::string_view text, const std::string& file);
/// KITTI times.txt: seconds, one per image.
std::vector<Nanoseconds> parse_times(std::string_view text, const std::string& file);

/// What order_by_stamp had to do.
struct OrderRepair {
  std::size_t unordered = 0;   ///< rows that came before their predecessor in time
  std::size_t duplicates = 0;  ///< rows removed because their stamp was there already
  /// "3 unordered rows sorted, 1 duplicate stamp removed"; empty when nothing was done.
  std::string description() const;
};

/// Sorts rows by stamp and keeps the first of each stamp.
template <class Row>
OrderRepair order_by_stamp(std::vector<Row>& rows) {
  OrderRepair repair;
  const auto earlier = [](const Row& a, const Row& b) { return a.stamp_ns < b.stamp_ns; };
  for (std::size_t i = 1; i < rows.size(); ++i) repair.unordered += earlier(rows[i], rows[i - 1]);
  std::stable_sort(rows.begin(), rows.end(), earlier);
  const auto end = std::unique(rows.begin(), rows.end(),
                               [](const Row& a, const Row& b) { return a.stamp_ns == b.stamp_ns; });
  repair.duplicates = static_cast<std::size_t>(rows.end() - end);
  rows.erase(end, rows.end());
  return repair;
}

}  // namespace fastloop::io
