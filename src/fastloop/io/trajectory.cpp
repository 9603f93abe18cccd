#include "fastloop/io/trajectory.hpp"

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <fstream>
#include <iterator>
#include <limits>

#include "fastloop/core/error.hpp"

namespace fastloop::io {
namespace {

constexpr double kKittiPeriodS = 0.1;
/// A stamp beyond this is nanoseconds: as seconds it would be three million years.
constexpr double kLargestSeconds = 1e14;

InputError::Where at(const std::string& file, int line = 0) {
  return {file, line, ""};
}

/// One line that holds data, split into fields.
struct Row {
  int line = 0;
  bool has_comma = false;
  std::vector<std::string_view> fields;
};

std::string read_file(const std::filesystem::path& file) {
  std::error_code ec;
  if (std::filesystem::is_directory(file, ec))
    throw InputError(at(file.string()), "is a folder", "a trajectory file");
  std::ifstream in(file, std::ios::binary);
  if (!in) throw InputError(at(file.string()), "cannot be opened", "a trajectory file");
  return {std::istreambuf_iterator<char>(in), {}};
}

bool is_separator(char c) {
  return c == ' ' || c == '\t' || c == ',' || c == '\r' || c == ';';
}

/// A comma and the blanks around it are one separator; a trailing comma adds no field.
std::vector<std::string_view> split(std::string_view line) {
  std::vector<std::string_view> fields;
  std::size_t i = 0;
  while (i < line.size()) {
    while (i < line.size() && is_separator(line[i])) ++i;
    const std::size_t begin = i;
    while (i < line.size() && !is_separator(line[i])) ++i;
    if (i > begin) fields.push_back(line.substr(begin, i - begin));
  }
  return fields;
}

std::vector<Row> split_rows(std::string_view text) {
  if (text.starts_with("\xEF\xBB\xBF")) text.remove_prefix(3);
  std::vector<Row> rows;
  int line_number = 0;
  while (!text.empty()) {
    const std::size_t end = std::min(text.find('\n'), text.size());
    ++line_number;
    const std::string_view line = text.substr(0, end);
    Row row{line_number, line.find(',') != std::string_view::npos, split(line)};
    text.remove_prefix(std::min(end + 1, text.size()));
    if (row.fields.empty() || row.fields[0][0] == '#') continue;
    if (line_number == 1 && row.has_comma &&
        std::isalpha(static_cast<unsigned char>(row.fields[0][0])))
      continue;  // a header
    rows.push_back(std::move(row));
  }
  return rows;
}

double parse_finite(std::string_view text, const std::string& file, int line) {
  if (text.starts_with('+')) text.remove_prefix(1);
  double value = 0;
  const auto [end, ec] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (ec != std::errc{} || end != text.data() + text.size())
    throw InputError(at(file, line), "'" + std::string(text.substr(0, 40)) + "' is not a number");
  if (!std::isfinite(value))
    throw InputError(at(file, line), "'" + std::string(text) + "' is not finite",
                     "a finite number");
  return value;
}

Nanoseconds parse_stamp(std::string_view text, int shift, const std::string& file, int line) {
  const auto stamp_ns = parse_decimal(text, shift);
  if (!stamp_ns)
    throw InputError(at(file, line),
                     "'" + std::string(text.substr(0, 40)) + "' is not a time stamp",
                     shift == 9 ? "seconds" : "nanoseconds");
  return *stamp_ns;
}

SE3 pose_from(const Vector3d& translation, const Eigen::Quaterniond& q, const std::string& file,
              int line) {
  const double norm = q.norm();
  if (!(norm > 0.9 && norm < 1.1))
    throw InputError(at(file, line), "the quaternion has norm " + std::to_string(norm), "norm 1");
  return {q, translation};
}

/// @param order  column of x, y, z, w of the quaternion
StampedPose parse_pose(const Row& row, int shift, const int (&order)[4], const std::string& file) {
  const auto number = [&](int column) { return parse_finite(row.fields[column], file, row.line); };
  const Vector3d translation(number(1), number(2), number(3));
  const Eigen::Quaterniond q(number(order[3]), number(order[0]), number(order[1]),
                             number(order[2]));
  return {parse_stamp(row.fields[0], shift, file, row.line),
          pose_from(translation, q, file, row.line)};
}

SE3 parse_kitti(const Row& row, const std::string& file) {
  Eigen::Matrix4d m = Eigen::Matrix4d::Identity();
  for (int i = 0; i < 12; ++i) m(i / 4, i % 4) = parse_finite(row.fields[i], file, row.line);
  const Matrix3d r = m.topLeftCorner<3, 3>();
  if ((r.transpose() * r - Matrix3d::Identity()).norm() > 1e-2 || r.determinant() < 0)
    throw InputError(at(file, row.line), "the left 3x3 block is not a rotation",
                     "a 3x4 pose matrix [R|t], row by row");
  return SE3::from_matrix(m);
}

void expect_columns(const Row& row, std::size_t least, std::size_t most, const std::string& file,
                    const char* expected) {
  if (row.fields.size() < least || row.fields.size() > most)
    throw InputError(at(file, row.line), std::to_string(row.fields.size()) + " columns", expected);
}

TrajectoryFormat detect(const Row& first, const std::string& file) {
  const std::size_t columns = first.fields.size();
  if (first.has_comma && columns >= 8) return TrajectoryFormat::kEuroc;
  if (columns == 8) return TrajectoryFormat::kTum;
  if (columns == 12) return TrajectoryFormat::kKitti;
  throw InputError(at(file, first.line), std::to_string(columns) + " columns",
                   "TUM (8, blanks), EuRoC (8 or more, commas) or KITTI (12, blanks)");
}

std::vector<Nanoseconds> read_times(const std::filesystem::path& file) {
  const std::string text = read_file(file);
  std::vector<Nanoseconds> stamps;
  for (const Row& row : split_rows(text)) {
    expect_columns(row, 1, 1, file.string(), "one time in seconds a line");
    stamps.push_back(parse_stamp(row.fields[0], 9, file.string(), row.line));
  }
  return stamps;
}

/// Stamps of a KITTI trajectory of `count` poses; says in `remarks` where they come from.
std::vector<Nanoseconds> kitti_stamps(const std::filesystem::path& file, std::size_t count,
                                      const TrajectoryOptions& options,
                                      std::vector<std::string>& remarks) {
  if (options.kitti_times) {
    auto stamps = read_times(*options.kitti_times);
    if (stamps.size() != count)
      throw InputError(at(options.kitti_times->string()), std::to_string(stamps.size()) + " times",
                       std::to_string(count) + ", one for each pose of " + file.string());
    return stamps;
  }
  const auto folder = file.parent_path();
  for (const auto& candidate :
       {folder / "times.txt", folder / ".." / "sequences" / file.stem() / "times.txt"}) {
    std::error_code ec;
    if (!std::filesystem::is_regular_file(candidate, ec)) continue;
    auto stamps = read_times(candidate);
    if (stamps.size() == count) {
      remarks.push_back("stamps from " + candidate.lexically_normal().string());
      return stamps;
    }
    remarks.push_back(candidate.lexically_normal().string() +
                      " has another number of lines: ignored");
  }
  std::vector<Nanoseconds> stamps(count);
  for (std::size_t i = 0; i < count; ++i)
    stamps[i] = from_seconds(static_cast<double>(i) * kKittiPeriodS);
  remarks.emplace_back("no stamps in this format: 10 poses a second assumed, from zero");
  return stamps;
}

void sort_and_drop_repeats(Trajectory& trajectory) {
  auto& poses = trajectory.poses;
  const auto earlier = [](const StampedPose& a, const StampedPose& b) {
    return a.stamp_ns < b.stamp_ns;
  };
  std::size_t disordered = 0;
  for (std::size_t i = 1; i < poses.size(); ++i) disordered += earlier(poses[i], poses[i - 1]);
  if (disordered > 0) {
    std::stable_sort(poses.begin(), poses.end(), earlier);
    trajectory.remarks.push_back(std::to_string(disordered) + " poses out of order: sorted");
  }
  const auto last = std::unique(poses.begin(), poses.end(), [](const auto& a, const auto& b) {
    return a.stamp_ns == b.stamp_ns;
  });
  if (const auto repeats = std::distance(last, poses.end()); repeats > 0) {
    poses.erase(last, poses.end());
    trajectory.remarks.push_back(std::to_string(repeats) +
                                 " repeated stamps: the first of each kept");
  }
}

void append_fixed(std::string& out, double value) {
  // Values that round to zero must not write "-0.000000000".
  if (std::abs(value) < 0.5e-9) value = 0;
  char buffer[400];  // the largest double has 309 digits before the point
  const auto result =
      std::to_chars(buffer, buffer + sizeof buffer, value, std::chars_format::fixed, 9);
  out.append(buffer, result.ptr);
}

/// The one of the pair (q, -q) whose first non-zero component, in the order w, z, y, x, is
/// positive.
Eigen::Quaterniond canonical(Eigen::Quaterniond q) {
  for (const double c : {q.w(), q.z(), q.y(), q.x()}) {
    if (c > 0) return q;
    if (c < 0) break;
  }
  q.coeffs() = -q.coeffs();
  return q;
}

}  // namespace

const char* to_string(TrajectoryFormat format) {
  switch (format) {
    case TrajectoryFormat::kAuto:
      return "auto";
    case TrajectoryFormat::kTum:
      return "tum";
    case TrajectoryFormat::kEuroc:
      return "euroc";
    case TrajectoryFormat::kKitti:
      return "kitti";
  }
  return "unknown";
}

std::optional<Nanoseconds> parse_decimal(std::string_view text, int shift) {
  bool negative = false;
  if (!text.empty() && (text[0] == '-' || text[0] == '+')) {
    negative = text[0] == '-';
    text.remove_prefix(1);
  }
  std::string digits;
  int exponent = shift;
  bool after_point = false;
  std::size_t i = 0;
  for (; i < text.size() && text[i] != 'e' && text[i] != 'E'; ++i) {
    if (text[i] == '.' && !after_point) {
      after_point = true;
    } else if (text[i] >= '0' && text[i] <= '9') {
      digits.push_back(text[i]);
      exponent -= after_point;
    } else {
      return std::nullopt;
    }
  }
  if (digits.empty()) return std::nullopt;
  if (i < text.size()) {
    std::string_view tail = text.substr(i + 1);
    if (tail.starts_with('+')) tail.remove_prefix(1);
    int written = 0;
    const auto [end, ec] = std::from_chars(tail.data(), tail.data() + tail.size(), written);
    if (ec != std::errc{} || end != tail.data() + tail.size() || std::abs(written) > 1000)
      return std::nullopt;
    exponent += written;
  }
  // Keep the digits in front of the shifted point; the one behind it rounds.
  const auto kept = static_cast<long>(digits.size()) + exponent;
  const bool round_up = kept >= 0 && exponent < 0 && digits[static_cast<std::size_t>(kept)] >= '5';
  digits.resize(static_cast<std::size_t>(std::clamp(kept, 0L, 2000L)), '0');
  Nanoseconds value = 0;
  for (const char c : digits) {
    if (value > (std::numeric_limits<Nanoseconds>::max() - 10) / 10) return std::nullopt;
    value = value * 10 + (c - '0');
  }
  value += round_up;
  return negative ? -value : value;
}

std::string format_seconds(Nanoseconds stamp_ns) {
  const bool negative = stamp_ns < 0;
  const auto magnitude =
      negative ? 0 - static_cast<std::uint64_t>(stamp_ns) : static_cast<std::uint64_t>(stamp_ns);
  std::string decimals = std::to_string(magnitude % 1'000'000'000u);
  decimals.insert(0, 9 - decimals.size(), '0');
  return (negative ? "-" : "") + std::to_string(magnitude / 1'000'000'000u) + "." + decimals;
}

std::string to_tum_line(const StampedPose& pose) {
  const Eigen::Quaterniond q = canonical(pose.T_world_x.rotation);
  const Vector3d& t = pose.T_world_x.translation;
  std::string line = format_seconds(pose.stamp_ns);
  for (const double value : {t.x(), t.y(), t.z(), q.x(), q.y(), q.z(), q.w()}) {
    line.push_back(' ');
    append_fixed(line, value);
  }
  return line;
}

void write_tum(const std::filesystem::path& file, std::span<const StampedPose> poses) {
  std::ofstream out(file, std::ios::binary | std::ios::trunc);
  if (!out)
    throw InputError(at(file.string()), "cannot be written", "a folder with write permission");
  for (const StampedPose& pose : poses) out << to_tum_line(pose) + "\n";
  out.close();
  if (!out)
    throw InputError(at(file.string()), "could not be written completely", "space on the disk");
}

Trajectory read_trajectory(const std::filesystem::path& file, const TrajectoryOptions& options) {
  const std::string name = file.string();
  const std::string text = read_file(file);
  const std::vector<Row> rows = split_rows(text);
  if (rows.empty()) throw InputError(at(name), "holds no poses", "at least one line of numbers");

  Trajectory trajectory;
  trajectory.format =
      options.format == TrajectoryFormat::kAuto ? detect(rows[0], name) : options.format;
  trajectory.poses.reserve(rows.size());
  if (trajectory.format == TrajectoryFormat::kKitti) {
    const auto stamps = kitti_stamps(file, rows.size(), options, trajectory.remarks);
    for (std::size_t i = 0; i < rows.size(); ++i) {
      expect_columns(rows[i], 12, 12, name, "12 columns: a 3x4 pose matrix");
      trajectory.poses.push_back({stamps[i], parse_kitti(rows[i], name)});
    }
  } else if (trajectory.format == TrajectoryFormat::kEuroc) {
    for (const Row& row : rows) {
      expect_columns(row, 8, 1000, name, "8 or more columns: t,px,py,pz,qw,qx,qy,qz");
      trajectory.poses.push_back(parse_pose(row, 0, {5, 6, 7, 4}, name));
    }
  } else {
    const bool in_ns =
        std::abs(parse_finite(rows[0].fields[0], name, rows[0].line)) > kLargestSeconds;
    if (in_ns) trajectory.remarks.emplace_back("stamps taken as nanoseconds");
    for (const Row& row : rows) {
      expect_columns(row, 8, 8, name, "8 columns: t tx ty tz qx qy qz qw");
      trajectory.poses.push_back(parse_pose(row, in_ns ? 0 : 9, {4, 5, 6, 7}, name));
    }
  }
  sort_and_drop_repeats(trajectory);
  return trajectory;
}

}  // namespace fastloop::io
