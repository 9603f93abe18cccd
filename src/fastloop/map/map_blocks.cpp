#include "fastloop/map/map_blocks.hpp"

#include <fcntl.h>
#include <unistd.h>
#include <zstd.h>

#include <cerrno>

#include "fastloop/core/checksum.hpp"

namespace fastloop::map {
namespace {

constexpr std::array<char, 8> kMagic{'f', 'l', 'm', 'a', 'p', '\r', '\n', '\x1a'};
constexpr std::uint32_t kVersion = 1;
constexpr char kEnd[] = "end";
constexpr int kCompressionLevel =
    1;  // the higher ones gain a few percent for several times the time

struct FileHeader {
  std::array<char, 8> magic = kMagic;
  std::uint32_t version = kVersion;
  std::uint32_t reserved = 0;
};
static_assert(sizeof(FileHeader) == 16);

std::uint64_t checksum_of(BlockHeader header, std::span<const std::byte> packed) {
  header.checksum = 0;
  return crc64(packed, crc64(std::as_bytes(std::span(&header, 1))));
}

}  // namespace

BlockFileWriter::BlockFileWriter(const std::filesystem::path& path)
    : path_(path), temporary_(path.string() + ".part" + std::to_string(::getpid())) {
  const int descriptor = ::open(temporary_.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
  file_ = descriptor < 0 ? nullptr : ::fdopen(descriptor, "wb");
  if (!file_) fail("the map cannot be written");
  const FileHeader header;
  put(&header, sizeof(header));
}

BlockFileWriter::~BlockFileWriter() {
  if (!file_) return;
  std::fclose(file_);
  ::unlink(temporary_.c_str());
}

void BlockFileWriter::write(const std::string& name, std::span<const std::byte> bytes) {
  if (bytes.size() > kMaxBlockBytes)
    throw InvalidArgument("a single '" + name + "' entry of a map is larger than 64 MiB");
  packed_.resize(ZSTD_compressBound(bytes.size()));
  const std::size_t packed =
      ZSTD_compress(packed_.data(), packed_.size(), bytes.data(), bytes.size(), kCompressionLevel);
  if (ZSTD_isError(packed)) throw Error(std::string("zstd: ") + ZSTD_getErrorName(packed));
  BlockHeader header;
  std::memcpy(header.name.data(), name.data(), std::min(name.size(), header.name.size()));
  header.number = blocks_++;
  header.bytes = static_cast<std::uint32_t>(bytes.size());
  header.packed_bytes = packed;
  header.checksum = checksum_of(header, std::span(packed_).first(packed));
  put(&header, sizeof(header));
  put(packed_.data(), packed);
}

void BlockFileWriter::finish() {
  write(kEnd, {});
  // The name must not point to a file whose contents are still on their way to the disk.
  if (std::fflush(file_) != 0 || ::fsync(::fileno(file_)) != 0) fail("the map cannot be written");
  const int closed = std::fclose(file_);
  file_ = nullptr;
  if (closed != 0 || std::rename(temporary_.c_str(), path_.c_str()) != 0) {
    const int error = errno;
    ::unlink(temporary_.c_str());
    errno = error;
    fail("the map cannot be written");
  }
}

void BlockFileWriter::put(const void* data, std::size_t bytes) {
  if (std::fwrite(data, 1, bytes, file_) != bytes) fail("the map cannot be written");
}

void BlockFileWriter::fail(const char* what) const {
  throw InputError({path_.string(), 0, ""}, std::string(what) + ": " + std::strerror(errno));
}

BlockFileReader::BlockFileReader(const std::filesystem::path& path) : name_(path.string()) {
  if (std::filesystem::is_directory(path)) fail("is a folder", "a map file");
  file_.open(path, std::ios::binary | std::ios::ate);
  if (!file_) fail(std::string("cannot be opened: ") + std::strerror(errno));
  const auto size = file_.tellg();
  if (size < 0) fail("is not a file that can be read from any place");
  left_ = static_cast<std::uint64_t>(size);
  file_.seekg(0);
  FileHeader header;
  if (left_ < sizeof(header)) fail("is too short for a map", "a map file of fastloop");
  get(&header, sizeof(header));
  if (header.magic != kMagic) fail("is not a map", "a map file of fastloop");
  if (header.version > kVersion)
    fail("has version " + std::to_string(header.version) + ", which is newer than this program",
         "version " + std::to_string(kVersion));
  if (header.version != kVersion || header.reserved != 0) fail("is damaged at its beginning");
}

bool BlockFileReader::next() {
  if (left_ < sizeof(header_)) fail("is cut short: its end is missing");
  get(&header_, sizeof(header_));
  const std::string block = "block " + std::to_string(blocks_);
  if (header_.number != blocks_++ || header_.bytes > kMaxBlockBytes ||
      header_.packed_bytes > ZSTD_compressBound(kMaxBlockBytes))
    fail("is damaged: the header of " + block + " cannot be right");
  if (header_.packed_bytes > left_) fail("is cut short in " + block);
  packed_.resize(header_.packed_bytes);
  get(packed_.data(), packed_.size());
  if (header_.checksum != checksum_of(header_, packed_))
    fail("is damaged: the checksum of " + block + " is wrong");
  if (header_.text() != kEnd) return true;
  if (left_ > 0) fail("has " + std::to_string(left_) + " bytes after its end");
  return false;
}

std::span<const std::byte> BlockFileReader::unpack() {
  unpacked_.resize(header_.bytes);
  const std::size_t size =
      ZSTD_decompress(unpacked_.data(), unpacked_.size(), packed_.data(), packed_.size());
  if (ZSTD_isError(size) || size != unpacked_.size())
    fail("is damaged: block " + std::to_string(header_.number) + " cannot be unpacked");
  return unpacked_;
}

void BlockFileReader::get(void* data, std::size_t bytes) {
  file_.read(static_cast<char*>(data), static_cast<std::streamsize>(bytes));
  if (static_cast<std::size_t>(file_.gcount()) != bytes) fail("cannot be read");
  left_ -= bytes;
}

void BlockFileReader::fail(const std::string& what, const std::string& expected) const {
  throw InputError({name_, 0, ""}, what, expected);
}

}  // namespace fastloop::map
