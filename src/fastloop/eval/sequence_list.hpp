#pragma once

#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <vector>

namespace fastloop::eval {

enum class SequenceKind {
  kReal,       ///< recorded images
  kHalfReal,   ///< recorded motion, time stamps and IMU; rendered images
  kSimulated,  ///< everything from the simulator
  kUnknown,    ///< a folder that no list names
};
const char* to_string(SequenceKind kind);

/// How to make a sequence that is not there; arguments of `fastloop simulate`.
struct SimulationRecipe {
  std::string world, camera;
  double seconds = 0;  ///< 0: the usual length of the world
};

/// One way to get at a sequence.
struct SequenceSource {
  SequenceKind kind = SequenceKind::kUnknown;
  std::vector<std::string> folders;  ///< below a root; any of them
  std::optional<SimulationRecipe> simulate;
};

/// A row of a table (eval/sequences.yaml).
struct SequenceRow {
  std::string name, group, mode = "auto";
  bool paper = false;
  std::vector<SequenceSource> sources;  ///< the preferred one first
};

/// @param file  name used in messages
/// @throws InputError with line and key, also when a name comes twice
std::vector<SequenceRow> parse_sequences(const std::string& text, const std::string& file);

/// Where a row's sequence lies. `folder` is empty when it has to be simulated first.
struct LocatedSequence {
  SequenceKind kind = SequenceKind::kUnknown;
  std::filesystem::path folder;
  std::optional<SimulationRecipe> simulate;
};
/// The first source whose folder exists under one of the roots, else the first that can be
/// simulated, else nothing.
std::optional<LocatedSequence> locate(const SequenceRow& row,
                                      std::span<const std::filesystem::path> roots);

/// The row and kind of a folder that was named directly: the one with the longest folder name that
/// the path ends with. A folder no row knows makes a row of its own; what the simulator wrote is
/// recognised by its marker.
struct NamedFolder {
  SequenceRow row;
  SequenceKind kind = SequenceKind::kUnknown;
};
NamedFolder classify(const std::filesystem::path& folder, std::span<const SequenceRow> rows);

}  // namespace fastloop::eval
