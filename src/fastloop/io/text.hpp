#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

#include "fastloop/core/error.hpp"
#include "fastloop/core/time.hpp"

/// Small strict parsers shared by the readers. They never depend on the locale.
namespace fastloop::io {

std::string_view trimmed(std::string_view text);
std::string lower_case(std::string_view text);

/// The whole text as a number; "nan" and "inf" are numbers too. Nothing when anything else is in
/// it.
std::optional<double> parse_number(std::string_view text);

/// Whole nanoseconds; a fraction ("1403715274312143104.000") is rounded down. Exact.
std::optional<Nanoseconds> parse_nanoseconds(std::string_view text);

/// Decimal seconds ("1403715273.262140", "1.5e-1") to nanoseconds; plain decimals are converted
/// exactly.
std::optional<Nanoseconds> parse_seconds(std::string_view text);

/// Place in a file, for an InputError.
inline InputError::Where in_file(const std::filesystem::path& path, int line = 0,
                                 std::string key = "") {
  return {path.string(), line, std::move(key)};
}

/// Whole file. @throws InputError when it cannot be read.
std::string read_text_file(const std::filesystem::path& path);

/// Writes the whole file. @throws InputError when that fails.
void write_text_file(const std::filesystem::path& path, const std::string& text);

}  // namespace fastloop::io
