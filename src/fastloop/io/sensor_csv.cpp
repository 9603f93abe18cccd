#include "fastloop/io/sensor_csv.hpp"

#include <cmath>

#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

/// A line that is neither blank nor a comment, split into fields.
struct Row {
  std::string_view text;
  std::vector<std::string_view> fields;
  int line = 0;
};

std::vector<std::string_view> split_at_commas(std::string_view text) {
  std::vector<std::string_view> fields;
  while (true) {
    const std::size_t comma = text.find(',');
    fields.push_back(trimmed(text.substr(0, comma)));
    if (comma == std::string_view::npos) break;
    text.remove_prefix(comma + 1);
  }
  if (fields.size() > 1 && fields.back().empty())
    fields.pop_back();  // a comma at the end of a line
  return fields;
}

std::vector<std::string_view> split_at_blanks(std::string_view text) {
  std::vector<std::string_view> fields;
  while (!(text = trimmed(text)).empty()) {
    const std::size_t end = text.find_first_of(" \t");
    fields.push_back(text.substr(0, end));
    text.remove_prefix(fields.back().size());
  }
  return fields;
}

template <class Split, class Use>
void for_each_row(std::string_view text, Split split, Use use) {
  if (text.substr(0, 3) == "\xEF\xBB\xBF") text.remove_prefix(3);
  Row row;
  bool first = true;
  while (!text.empty()) {
    const std::size_t end = text.find('\n');
    row.text = trimmed(text.substr(0, end));
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
    ++row.line;
    if (row.text.empty() || row.text.front() == '#') continue;
    // A heading without the comment sign, as spreadsheets write it.
    const bool heading = first && lower_case(row.text.substr(0, 4)) == "time";
    first = false;
    if (heading) continue;
    row.fields = split(row.text);
    use(row);
  }
}

[[noreturn]] void reject(const Row& row, const std::string& file, const std::string& expected) {
  std::string shown(row.text.substr(0, 60));
  for (char& c : shown)
    if (c < ' ' || c > '~') c = '?';
  throw InputError(in_file(file, row.line), "cannot be read: '" + shown + "'", expected);
}

}  // namespace

std::vector<StampedFile> parse_image_csv(std::string_view text, const std::string& file) {
  std::vector<StampedFile> rows;
  for_each_row(text, split_at_commas, [&](const Row& row) {
    const auto stamp = parse_nanoseconds(row.fields[0]);
    if (!stamp || row.fields.size() != 2 || row.fields[1].empty())
      reject(row, file, "time stamp in nanoseconds, comma, image file name");
    rows.push_back({*stamp, std::string(row.fields[1])});
  });
  return rows;
}

ImuTable parse_imu_csv(std::string_view text, const std::string& file) {
  ImuTable table;
  for_each_row(text, split_at_commas, [&](const Row& row) {
    const std::string expected =
        "time stamp in nanoseconds, 3 angular rates (rad/s), 3 accelerations (m/s^2), separated by "
        "commas";
    const auto stamp = parse_nanoseconds(row.fields[0]);
    if (!stamp || row.fields.size() != 7) reject(row, file, expected);
    Vector6d values;
    for (int i = 0; i < 6; ++i) {
      const auto value = parse_number(row.fields[static_cast<std::size_t>(i) + 1]);
      if (!value) reject(row, file, expected);
      values[i] = *value;
    }
    if (values.allFinite()) {
      table.samples.push_back({*stamp, values.head<3>(), values.tail<3>()});
    } else {
      table.not_finite.push_back(row.line);
    }
  });
  return table;
}

std::vector<StampedFile> parse_image_list(std::string_view text, const std::string& file) {
  std::vector<StampedFile> rows;
  for_each_row(text, split_at_blanks, [&](const Row& row) {
    const auto stamp = parse_seconds(row.fields[0]);
    if (!stamp || row.fields.size() != 2)
      reject(row, file, "time stamp in seconds, image file name");
    rows.push_back({*stamp, std::string(row.fields[1])});
  });
  return rows;
}

std::vector<ImageAssociation> parse_associations(std::string_view text, const std::string& file) {
  std::vector<ImageAssociation> rows;
  for_each_row(text, split_at_blanks, [&](const Row& row) {
    const auto& f = row.fields;
    const auto first = parse_seconds(f[0]);
    const auto second = f.size() == 4 ? parse_seconds(f[2]) : std::nullopt;
    if (!first || !second) reject(row, file, "seconds, colour image, seconds, depth image");
    const bool depth_first = f[1].substr(0, 5) == "depth" && f[3].substr(0, 5) != "depth";
    if (depth_first) {
      rows.push_back({*second, std::string(f[3]), std::string(f[1])});
    } else {
      rows.push_back({*first, std::string(f[1]), std::string(f[3])});
    }
  });
  return rows;
}

std::vector<Nanoseconds> parse_times(std::string_view text, const std::string& file) {
  std::vector<Nanoseconds> times;
  for_each_row(text, split_at_blanks, [&](const Row& row) {
    const auto stamp = parse_seconds(row.fields[0]);
    if (!stamp || row.fields.size() != 1) reject(row, file, "one time stamp in seconds");
    times.push_back(*stamp);
  });
  return times;
}

std::string OrderRepair::description() const {
  std::string text;
  if (unordered > 0) text = std::to_string(unordered) + " unordered row(s) sorted";
  if (duplicates > 0)
    text += (text.empty() ? "" : ", ") + std::to_string(duplicates) + " duplicate stamp(s) removed";
  return text;
}

}  // namespace fastloop::io
