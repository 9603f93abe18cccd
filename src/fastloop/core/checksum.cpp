#include "fastloop/core/checksum.hpp"

#include <array>

namespace fastloop {
namespace {

constexpr std::uint64_t kPolynomial = 0xC96C5795D7870F42ull;  // bits reversed

/// Row k: remainder of a byte followed by k zero bytes. Eight bytes are taken at a time.
constexpr auto make_tables() {
  std::array<std::array<std::uint64_t, 256>, 8> tables{};
  for (std::uint64_t byte = 0; byte < 256; ++byte) {
    std::uint64_t r = byte;
    for (int bit = 0; bit < 8; ++bit) r = (r >> 1) ^ (r & 1 ? kPolynomial : 0);
    tables[0][byte] = r;
  }
  for (std::size_t k = 1; k < 8; ++k)
    for (std::size_t byte = 0; byte < 256; ++byte) {
      const std::uint64_t r = tables[k - 1][byte];
      tables[k][byte] = (r >> 8) ^ tables[0][r & 0xff];
    }
  return tables;
}
constexpr auto kTables = make_tables();

}  // namespace

std::uint64_t crc64(std::span<const std::byte> bytes, std::uint64_t previous) {
  std::uint64_t crc = ~previous;
  std::size_t i = 0;
  for (; i + 8 <= bytes.size(); i += 8) {
    std::uint64_t word = 0;
    for (std::size_t b = 0; b < 8; ++b)
      word |= std::to_integer<std::uint64_t>(bytes[i + b]) << (8 * b);
    word ^= crc;
    crc = 0;
    for (std::size_t b = 0; b < 8; ++b) crc ^= kTables[7 - b][(word >> (8 * b)) & 0xff];
  }
  for (; i < bytes.size(); ++i)
    crc = (crc >> 8) ^ kTables[0][(crc ^ std::to_integer<std::uint64_t>(bytes[i])) & 0xff];
  return ~crc;
}

}  // namespace fastloop
