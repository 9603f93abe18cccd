#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/system/system.hpp"

namespace fastloop::io {

/// Memory and size of the map at one time of a run.
struct MemorySample {
  double t_s = 0;     ///< time of the data set since its first processed frame
  double wall_s = 0;  ///< since the run began
  double resident_mib = 0;
  std::size_t keyframes = 0, landmarks = 0;
};

/// The computer and the program; empty or 0 where it is not known.
struct MachineFacts {
  std::string cpu, compiler, build, commit;
  unsigned cores = 0;
  double memory_gib = 0;
};

/// Facts of a run that the system itself does not know.
struct RunFacts {
  std::string dataset;
  std::size_t frames_available = 0, frames_dropped = 0;
  double wall_seconds = 0;
  bool interrupted = false;
  std::vector<std::string> remarks;  ///< of the data set
  SE3 T_body_cam0;
  std::string ground_truth;  ///< file of the data set; empty when it has none
  std::vector<MemorySample> memory;
  double peak_mib = 0;
  std::optional<CudaCounters> device;  ///< nothing when no step asked for one
  MachineFacts machine;
};

/// Creates the folder and checks that files can be written there.
/// @throws InputError when it cannot
void prepare_output_folder(const std::filesystem::path& folder);

/// Writes all result files of a finished run (docs/outputs.md).
/// @throws InputError naming the file that could not be written completely
void write_run_output(const std::filesystem::path& folder, const system::System& system,
                      const RunFacts& facts);

/// Numbers of summary.json, for the closing lines of the program.
struct RunSummary {
  std::size_t frames = 0, tracked = 0, tracked_since_start = 0, frames_since_start = 0,
              keyframes = 0, landmarks = 0, maps = 0, loops = 0, merges = 0;
};
RunSummary summarize_run(const system::System& system);

}  // namespace fastloop::io
