#pragma once

#include <filesystem>
#include <functional>

#include "fastloop/sim/sequence.hpp"

namespace fastloop::sim {

struct WriteOptions {
  std::filesystem::path folder;
  int threads = 0;  ///< 0 = all
  /// Called after each frame, from any thread, one call at a time.
  std::function<void(std::size_t done, std::size_t total)> progress;
};

/// Writes a sequence as files: EuRoC layout (mav0/...), or the TUM RGB-D layout for a depth camera with
/// `calibration.yaml` beside it. A folder that holds an earlier simulation is replaced; any other folder must
/// be empty or absent.
/// @throws InputError naming the file or folder that cannot be written, or the lack of space
void write_sequence(const SimulatedSequence& sequence, const WriteOptions& options);

/// Writes bytes completely or throws InputError naming the file.
void write_bytes(const std::filesystem::path& file, const void* data, std::size_t size);

}  // namespace fastloop::sim
