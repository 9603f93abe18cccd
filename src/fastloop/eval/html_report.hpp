#pragma once

#include <optional>
#include <string>
#include <vector>

#include "fastloop/eval/run_folder.hpp"

namespace fastloop::eval {

struct ReportInput {
  RunFolder run;
  std::optional<io::Trajectory> ground_truth;
  std::string ground_truth_name;
  std::vector<Json> benches;  ///< results of `fastloop bench` to show beside
};

/// One page that tells a run: trajectory against ground truth before and after loops, errors over
/// time, what happened when, times, memory, tables of benches, the machine. Everything is in the
/// file: no script, no network. Every number carries the key and the exact value it was made from.
/// @throws InvalidArgument when a bench result is not one
std::string html_report(const ReportInput& input);

/// The numbers that the page shows of the evaluation, under the keys it gives them.
Json evaluation_json(const ReportInput& input);

}  // namespace fastloop::eval
