#include "fastloop/io/text.hpp"

#include <charconv>
#include <cmath>
#include <fstream>
#include <iterator>
#include <limits>

#include "fastloop/core/error.hpp"

namespace fastloop::io {
namespace {

constexpr Nanoseconds kMaxStamp = std::numeric_limits<Nanoseconds>::max();
constexpr Nanoseconds kNanosecondsPerSecond = 1'000'000'000;

bool is_digit(char c) {
  return c >= '0' && c <= '9';
}

/// Splits "123.456" into its parts; nothing unless it is digits with at most one point.
struct Decimal {
  std::string_view whole, fraction;
};
std::optional<Decimal> split_decimal(std::string_view text) {
  const std::size_t point = text.find('.');
  Decimal d{text.substr(0, point),
            point == std::string_view::npos ? std::string_view() : text.substr(point + 1)};
  if (d.whole.empty()) return std::nullopt;
  for (const char c : d.whole)
    if (!is_digit(c)) return std::nullopt;
  for (const char c : d.fraction)
    if (!is_digit(c)) return std::nullopt;
  return d;
}

std::optional<Nanoseconds> parse_digits(std::string_view digits) {
  Nanoseconds value = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), value);
  if (error != std::errc() || end != digits.data() + digits.size()) return std::nullopt;
  return value;
}

}  // namespace

std::string_view trimmed(std::string_view text) {
  const std::string_view blanks = " \t\r\n\v\f";
  const std::size_t begin = text.find_first_not_of(blanks);
  if (begin == std::string_view::npos) return {};
  return text.substr(begin, text.find_last_not_of(blanks) - begin + 1);
}

std::string lower_case(std::string_view text) {
  std::string out(text);
  for (char& c : out)
    if (c >= 'A' && c <= 'Z') c = static_cast<char>(c - 'A' + 'a');
  return out;
}

std::optional<double> parse_number(std::string_view text) {
  text = trimmed(text);
  // YAML spells the special values with a point in front; from_chars knows no plus sign.
  const std::string lower = text.size() <= 5 ? lower_case(text) : std::string();
  if (lower == ".nan") return std::numeric_limits<double>::quiet_NaN();
  if (lower == ".inf" || lower == "+.inf") return std::numeric_limits<double>::infinity();
  if (lower == "-.inf") return -std::numeric_limits<double>::infinity();
  if (text.size() > 1 && text.front() == '+' && text[1] != '-') text.remove_prefix(1);
  double value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || end != text.data() + text.size()) return std::nullopt;
  if (error == std::errc::result_out_of_range) return std::nullopt;
  if (error != std::errc()) return std::nullopt;
  return value;
}

std::optional<Nanoseconds> parse_nanoseconds(std::string_view text) {
  const auto decimal = split_decimal(trimmed(text));
  return decimal ? parse_digits(decimal->whole) : std::nullopt;
}

std::optional<Nanoseconds> parse_seconds(std::string_view text) {
  text = trimmed(text);
  if (const auto decimal = split_decimal(text)) {
    const auto whole = parse_digits(decimal->whole);
    if (!whole || *whole >= kMaxStamp / kNanosecondsPerSecond) return std::nullopt;
    std::string fraction(decimal->fraction.substr(0, 9));
    fraction.resize(9, '0');
    return *whole * kNanosecondsPerSecond + *parse_digits(fraction);
  }
  const auto value = parse_number(text);
  if (!value || !(*value >= 0) || *value > 9e9) return std::nullopt;
  return from_seconds(*value);
}

std::string read_text_file(const std::filesystem::path& path) {
  std::error_code ignored;
  if (std::filesystem::is_directory(path, ignored))
    throw InputError(in_file(path), "is a folder", "a file");
  std::ifstream in(path, std::ios::binary);
  if (!in) throw InputError(in_file(path), "cannot be opened", "a readable file");
  std::string text{std::istreambuf_iterator<char>(in), std::istreambuf_iterator<char>()};
  if (in.bad()) throw InputError(in_file(path), "cannot be read to its end");
  return text;
}

void write_text_file(const std::filesystem::path& path, const std::string& text) {
  std::ofstream out(path, std::ios::binary | std::ios::trunc);
  if (!out) throw InputError(in_file(path), "cannot be written", "a writable folder");
  out << text;
  out.close();
  if (!out) throw InputError(in_file(path), "could not be written completely", "free disk space");
}

}  // namespace fastloop::io
