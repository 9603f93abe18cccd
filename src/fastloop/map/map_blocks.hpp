#pragma once

#include <array>
#include <bit>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <span>
#include <string>
#include <type_traits>
#include <vector>

#include "fastloop/core/error.hpp"

/// The container of a map file: named blocks, each compressed and checksummed. Knows nothing of
/// maps. Part of map_file.
namespace fastloop::map {

static_assert(std::endian::native == std::endian::little,
              "numbers are written as they lie in memory");

/// Unpacked bytes of a block at most; no larger piece of memory is asked for on behalf of a file.
inline constexpr std::size_t kMaxBlockBytes = std::size_t{64} << 20;

template <class T>
concept Plain = std::is_arithmetic_v<T> || std::is_enum_v<T>;

class ByteWriter {
 public:
  template <Plain T>
  void put(T value) {
    put_bytes(&value, sizeof(value));
  }
  void put_bytes(const void* data, std::size_t bytes) {
    if (bytes == 0) return;
    const std::size_t at = bytes_.size();
    bytes_.resize(at + bytes);
    std::memcpy(bytes_.data() + at, data, bytes);
  }
  /// The elements alone, without their number.
  template <class T>
  void put_all(const std::vector<T>& values) {
    static_assert(std::is_trivially_copyable_v<T>);
    put_bytes(values.data(), values.size() * sizeof(T));
  }
  std::size_t size() const { return bytes_.size(); }
  std::span<const std::byte> bytes() const { return bytes_; }
  void clear() { bytes_.clear(); }

 private:
  std::vector<std::byte> bytes_;
};

/// Writes blocks to a temporary file beside `path` and gives it that name in `finish`. Without that
/// the temporary file is removed.
class BlockFileWriter {
 public:
  explicit BlockFileWriter(const std::filesystem::path& path);
  ~BlockFileWriter();
  BlockFileWriter(const BlockFileWriter&) = delete;
  BlockFileWriter& operator=(const BlockFileWriter&) = delete;

  /// @param name  at most 8 characters
  void write(const std::string& name, std::span<const std::byte> bytes);
  void finish();

 private:
  void put(const void* data, std::size_t bytes);
  [[noreturn]] void fail(const char* what) const;

  std::filesystem::path path_, temporary_;
  std::FILE* file_ = nullptr;
  std::uint32_t blocks_ = 0;
  std::vector<std::byte> packed_;
};

/// Header of a block in the file.
struct BlockHeader {
  std::array<char, 8> name{};
  std::uint32_t number = 0;  ///< 0, 1, ... in the file
  std::uint32_t bytes = 0;   ///< unpacked
  std::uint64_t packed_bytes = 0;
  std::uint64_t checksum = 0;  ///< of this header with checksum 0, then of the packed bytes

  std::string text() const { return std::string(name.data(), strnlen(name.data(), name.size())); }
};
static_assert(sizeof(BlockHeader) == 32);

/// Reads the blocks of a file one after the other; a block is intact when `next` returns.
class BlockFileReader {
 public:
  explicit BlockFileReader(const std::filesystem::path& path);

  /// False at the end of the file, which must be where the writer ended it.
  bool next();
  const BlockHeader& header() const { return header_; }
  /// Of the present block, unpacked; valid until the next call of `next`.
  std::span<const std::byte> unpack();
  [[noreturn]] void fail(const std::string& what, const std::string& expected = "") const;

 private:
  void get(void* data, std::size_t bytes);

  std::string name_;
  std::ifstream file_;
  std::uint64_t left_ = 0;  ///< bytes of the file not yet read
  std::uint32_t blocks_ = 0;
  BlockHeader header_;
  std::vector<std::byte> packed_, unpacked_;
};

}  // namespace fastloop::map
