#pragma once

#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "fastloop/core/time.hpp"
#include "fastloop/geometry/se3.hpp"

namespace fastloop::io {

/// Pose of some body `x` at one time; which body it is, the file name says.
struct StampedPose {
  Nanoseconds stamp_ns = 0;
  SE3 T_world_x;
};

enum class TrajectoryFormat {
  kAuto,  ///< recognised by separator and number of columns
  kTum,   ///< "t tx ty tz qx qy qz qw", seconds (or nanoseconds when t > 1e14, as ORB-SLAM3 writes)
  kEuroc,  ///< "t,px,py,pz,qw,qx,qy,qz,...", nanoseconds; further columns are ignored
  kKitti,  ///< first three rows of the 4x4 matrix, row by row, 12 numbers; stamps are kept
           ///< elsewhere
};

const char* to_string(TrajectoryFormat format);

struct TrajectoryOptions {
  TrajectoryFormat format = TrajectoryFormat::kAuto;
  /// Stamps of a KITTI file, seconds, one a line. Without it `times.txt` beside the file and
  /// `../sequences/NAME/times.txt` are tried, then 10 Hz from zero.
  std::optional<std::filesystem::path> kitti_times{};
};

/// A trajectory as read from a file.
struct Trajectory {
  std::vector<StampedPose> poses;  ///< at least one; stamps strictly increasing, poses finite
  TrajectoryFormat format = TrajectoryFormat::kAuto;
  std::vector<std::string> remarks;  ///< what was repaired ("12 poses were out of order: sorted")
};

/// Reads a TUM, EuRoC or KITTI trajectory. Comments (#), empty lines, CRLF and a byte-order mark
/// are accepted; poses out of order are sorted and repeated stamps dropped, each with a remark.
/// @throws InputError with file and line on anything that is not a number, not finite, of the wrong
///         number of columns, or not a rotation; on a missing or empty file.
Trajectory read_trajectory(const std::filesystem::path& file,
                           const TrajectoryOptions& options = {});

/// Writes the TUM format: seconds with nine decimals (exact), metres and quaternion with nine
/// decimals. Bytes depend on the poses only, not on locale; a quaternion and its negative write the
/// same.
/// @throws InputError naming the file when it cannot be written completely.
void write_tum(const std::filesystem::path& file, std::span<const StampedPose> poses);

/// One line of the TUM format, without the end of line.
std::string to_tum_line(const StampedPose& pose);

/// Exact decimal seconds, nine decimals: 1403715274312142104 -> "1403715274.312142104".
std::string format_seconds(Nanoseconds stamp_ns);

/// Decimal number times 10^shift, rounded to an integer without passing through a double.
/// "1403715274.312142104" with shift 9 -> 1403715274312142104. Accepts a sign and an exponent.
std::optional<Nanoseconds> parse_decimal(std::string_view text, int shift);

}  // namespace fastloop::io
