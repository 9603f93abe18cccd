#pragma once

#include <cstddef>
#include <filesystem>
#include <span>

#include "fastloop/place/vocabulary.hpp"

namespace fastloop::place {

/// Own format: a header (magic, version, sizes, checksum) and a zstd frame. Little-endian.
/// @throws InputError when the file cannot be written, read, or is damaged
void save_vocabulary(const VocabularyTree& tree, const std::filesystem::path& file);
VocabularyTree load_vocabulary(const std::filesystem::path& file);

/// The same from memory; `name` stands for the file in error messages.
VocabularyTree parse_vocabulary(std::span<const std::byte> bytes, const std::string& name);

/// DBoW2's text format: a line "k L scoring weighting", then per node, in any order in which
/// parents come first, "parent isLeaf d0 .. d31 weight". Nodes are numbered by line from 1; 0 is
/// the root. Only L1 scores with tf-idf weights ("0 0") can be used.
void save_vocabulary_text(const VocabularyTree& tree, const std::filesystem::path& file);
VocabularyTree load_vocabulary_text(const std::filesystem::path& file);

/// Either format, told apart by the first bytes.
VocabularyTree load_any_vocabulary(const std::filesystem::path& file);

}  // namespace fastloop::place
