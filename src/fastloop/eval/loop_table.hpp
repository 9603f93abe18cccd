#pragma once

#include <optional>
#include <string>
#include <vector>

#include "fastloop/eval/run_folder.hpp"
#include "fastloop/eval/sequence_list.hpp"
#include "fastloop/io/run_output.hpp"

namespace fastloop::eval {

/// How a table was made.
struct BenchInfo {
  std::string command, date;
  io::MachineFacts machine;
  int runs = 0, warm_up = 0;
  std::vector<std::string> backends;  ///< the first is what the others are compared with
};
/// Head of every result file: what was measured, when, where, how.
Json to_json(const BenchInfo& info, const std::string& kind);

/// What one run contributes to the table.
struct RunMeasurement {
  std::vector<PaperTimes> loops;  ///< of the loops that were closed
  std::vector<double> merges_ms;  ///< whole, of each merge of maps
  std::vector<double> tracking_around_loops_ms;
  StageStatistics tracking;                           ///< of all frames
  double ate_m = 0, coverage = 0, path_length_m = 0;  ///< 0 without ground truth
  double peak_mib = 0;
  std::optional<double> device_peak_mib, device_transfers_mib;  ///< nothing without a device
  std::size_t frames = 0, keyframes = 0;
};
RunMeasurement measure(const RunFolder& run, const std::optional<Evaluation>& evaluation);

/// A row: one sequence, all back ends.
struct SequenceResult {
  SequenceRow row;
  SequenceKind kind = SequenceKind::kUnknown;
  std::string data;          ///< name of the folder
  std::string ground_truth;  ///< name of the file; empty without
  std::string missing;       ///< why there are no numbers; empty when there are
  std::vector<std::vector<RunMeasurement>> runs;  ///< [back ends][runs]
  std::vector<std::string> warnings;
};

Json to_json(const SampleStatistics& s);
/// Statistics of every column of the paper over some loops.
Json columns_json(const std::vector<PaperTimes>& loops);

/// The table as data; the other forms are made from it, so that all show the same numbers. A back
/// end is one more entry of "backends" everywhere.
Json loop_table_json(const BenchInfo& info, const std::vector<SequenceResult>& results);
std::string loop_table_markdown(const Json& table);
/// One line for each sequence and back end.
std::string loop_table_csv(const Json& table);

/// Lines that say how a table was made: date, commit, machine, command, runs.
std::string provenance_markdown(const Json& table);
/// "12.3 ± 0.4", with as many digits as can be read.
std::string mean_and_sd(const Json& statistics);
/// Decimal text with about three significant digits.
std::string three_digits(double value);

}  // namespace fastloop::eval
