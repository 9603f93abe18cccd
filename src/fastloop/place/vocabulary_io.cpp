#include "fastloop/place/vocabulary_io.hpp"

#include <zstd.h>

#include <array>
#include <cstring>
#include <fstream>

#include "fastloop/core/error.hpp"

namespace fastloop::place {
namespace {

static_assert(std::endian::native == std::endian::little,
              "the format is written as it lies in memory");

constexpr std::array<char, 8> kMagic{'f', 'l', 'v', 'o', 'c', 'a', 'b', '\n'};
constexpr std::uint32_t kVersion = 1;
constexpr std::uint32_t kMaxNodes = 100'000'000;

struct Header {
  std::array<char, 8> magic = kMagic;
  std::uint32_t version = kVersion;
  std::uint32_t branching = 0, levels = 0, nodes = 0;
  std::uint64_t compressed_bytes = 0;
  std::uint64_t checksum = 0;  ///< of the header with checksum 0, then of the compressed bytes
};
static_assert(sizeof(Header) == 40);

/// FNV-1a on 64-bit words, the last one padded with zeros: fast enough for tens of megabytes.
std::uint64_t checksum(std::uint64_t hash, const void* data, std::size_t bytes) {
  const char* p = static_cast<const char*>(data);
  for (std::size_t i = 0; i < bytes; i += 8) {
    std::uint64_t word = 0;
    std::memcpy(&word, p + i, std::min<std::size_t>(8, bytes - i));
    hash = (hash ^ word) * 0x100000001b3ull;
    hash ^= hash >> 32;  // lets the upper bits of a word reach the lower ones
  }
  return hash;
}

std::uint64_t file_checksum(Header header, std::span<const std::byte> compressed) {
  header.checksum = 0;
  const std::uint64_t h = checksum(0xcbf29ce484222325ull, &header, sizeof(header));
  return checksum(h, compressed.data(), compressed.size());
}

std::size_t raw_size(std::size_t nodes) {
  return nodes * (1 + sizeof(Descriptor) + sizeof(float));
}

/// Number of children, descriptors and weights, one array after the other. A descriptor is stored
/// as the difference from its parent's, and weights by byte: both compress better so.
std::vector<std::byte> pack(const VocabularyTree& tree) {
  const std::size_t n = tree.size();
  std::vector<std::byte> raw(raw_size(n));
  std::byte* children = raw.data();
  std::byte* descriptors = children + n;
  std::byte* weights = descriptors + n * sizeof(Descriptor);
  for (std::size_t i = 0; i < n; ++i) {
    children[i] = static_cast<std::byte>(tree.first_child[i + 1] - tree.first_child[i]);
    for (std::uint32_t c = tree.first_child[i]; c < tree.first_child[i + 1]; ++c) {
      Descriptor d = tree.descriptor[c];
      if (i > 0)
        for (int w = 0; w < 4; ++w) d.words[w] ^= tree.descriptor[i].words[w];
      std::memcpy(descriptors + c * sizeof(d), &d, sizeof(d));
    }
    std::byte bytes[sizeof(float)];
    std::memcpy(bytes, &tree.weight[i], sizeof(float));
    for (std::size_t b = 0; b < sizeof(float); ++b) weights[b * n + i] = bytes[b];
  }
  return raw;
}

VocabularyTree unpack(const Header& header, const std::vector<std::byte>& raw,
                      const std::string& name) {
  const std::size_t n = header.nodes;
  const std::byte* children = raw.data();
  const std::byte* descriptors = children + n;
  const std::byte* weights = descriptors + n * sizeof(Descriptor);
  VocabularyTree tree;
  tree.branching = static_cast<int>(header.branching);
  tree.levels = static_cast<int>(header.levels);
  tree.descriptor.resize(n);
  tree.first_child.resize(n + 1);
  tree.weight.resize(n);
  std::memcpy(tree.descriptor.data(), descriptors, n * sizeof(Descriptor));
  tree.descriptor[0] = {};
  std::size_t next = 1;
  for (std::size_t i = 0; i < n; ++i) {
    tree.first_child[i] = static_cast<std::uint32_t>(next);
    const std::size_t end = next + std::to_integer<std::size_t>(children[i]);
    if (end > n || next <= i)
      throw InputError({name, 0, "nodes"}, "the tree of the vocabulary is broken");
    for (std::size_t c = next; i > 0 && c < end; ++c)
      for (int w = 0; w < 4; ++w) tree.descriptor[c].words[w] ^= tree.descriptor[i].words[w];
    next = end;
    std::byte bytes[sizeof(float)];
    for (std::size_t b = 0; b < sizeof(float); ++b) bytes[b] = weights[b * n + i];
    std::memcpy(&tree.weight[i], bytes, sizeof(float));
  }
  tree.first_child[n] = static_cast<std::uint32_t>(next);
  if (next != n) throw InputError({name, 0, "nodes"}, "the tree of the vocabulary is broken");
  return tree;
}

Header read_header(std::span<const std::byte> bytes, const std::string& name) {
  Header header;
  if (bytes.size() < sizeof(Header))
    throw InputError({name, 0, ""}, "the vocabulary is cut short", "a header of 40 bytes");
  std::memcpy(static_cast<void*>(&header), bytes.data(), sizeof(Header));
  if (header.magic != kMagic)
    throw InputError({name, 0, ""}, "not a vocabulary", "a file of `fastloop vocab`");
  if (header.version != kVersion)
    throw InputError({name, 0, "version"}, "version " + std::to_string(header.version),
                     "version " + std::to_string(kVersion));
  if (header.compressed_bytes != bytes.size() - sizeof(Header))
    throw InputError({name, 0, ""}, "the vocabulary has " + std::to_string(bytes.size()) + " bytes",
                     std::to_string(header.compressed_bytes + sizeof(Header)));
  if (header.checksum != file_checksum(header, bytes.subspan(sizeof(Header))))
    throw InputError({name, 0, "checksum"}, "the vocabulary is damaged");
  if (header.nodes < 2 || header.nodes > kMaxNodes)
    throw InputError({name, 0, "nodes"}, "impossible number of nodes");
  return header;
}

}  // namespace

VocabularyTree parse_vocabulary(std::span<const std::byte> bytes, const std::string& name) {
  const Header header = read_header(bytes, name);
  std::vector<std::byte> raw(raw_size(header.nodes));
  const std::size_t size = ZSTD_decompress(raw.data(), raw.size(), bytes.data() + sizeof(Header),
                                           bytes.size() - sizeof(Header));
  if (ZSTD_isError(size) || size != raw.size())
    throw InputError({name, 0, ""}, "the vocabulary cannot be decompressed");
  return unpack(header, raw, name);
}

void save_vocabulary(const VocabularyTree& tree, const std::filesystem::path& file) {
  const Vocabulary checked(tree);  // throws when it is not a tree
  const std::vector<std::byte> raw = pack(tree);
  std::vector<std::byte> compressed(ZSTD_compressBound(raw.size()));
  constexpr int kCompressionLevel = 12;
  const std::size_t size = ZSTD_compress(compressed.data(), compressed.size(), raw.data(),
                                         raw.size(), kCompressionLevel);
  if (ZSTD_isError(size)) throw Error("vocabulary: compression failed");
  compressed.resize(size);
  Header header;
  header.branching = static_cast<std::uint32_t>(tree.branching);
  header.levels = static_cast<std::uint32_t>(tree.levels);
  header.nodes = static_cast<std::uint32_t>(tree.size());
  header.compressed_bytes = size;
  header.checksum = file_checksum(header, compressed);
  std::ofstream out(file, std::ios::binary);
  out.write(reinterpret_cast<const char*>(&header), sizeof(header));
  out.write(reinterpret_cast<const char*>(compressed.data()), static_cast<std::streamsize>(size));
  out.close();
  if (!out) throw InputError({file.string(), 0, ""}, "cannot write the vocabulary");
}

VocabularyTree load_vocabulary(const std::filesystem::path& file) {
  std::ifstream in(file, std::ios::binary | std::ios::ate);
  if (!in) throw InputError({file.string(), 0, ""}, "cannot open the vocabulary");
  std::vector<std::byte> bytes(static_cast<std::size_t>(in.tellg()));
  in.seekg(0);
  in.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  if (!in) throw InputError({file.string(), 0, ""}, "cannot read the vocabulary");
  return parse_vocabulary(bytes, file.string());
}

VocabularyTree load_any_vocabulary(const std::filesystem::path& file) {
  std::array<char, kMagic.size()> start{};
  std::ifstream in(file, std::ios::binary);
  if (!in) throw InputError({file.string(), 0, ""}, "cannot open the vocabulary");
  in.read(start.data(), start.size());
  return start == kMagic ? load_vocabulary(file) : load_vocabulary_text(file);
}

}  // namespace fastloop::place
