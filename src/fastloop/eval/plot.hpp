#pragma once

#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include "fastloop/eval/evaluation.hpp"

namespace fastloop::eval {

/// True at the first pose after a gap of more than ten usual steps.
std::vector<bool> gaps(const std::vector<Nanoseconds>& stamps_ns);

/// The two axes in which poses move most, in the order x, y, z; x and y when it is close.
std::pair<int, int> view_axes(const std::vector<SE3>& poses);

/// Picture of an evaluation (SVG): both trajectories seen along the axis in which the reference
/// moves least (from above, as a rule), the error over time, and the numbers.
std::string to_svg(const Evaluation& evaluation, const std::string& title);

/// @throws InputError naming the file when it cannot be written completely
void write_svg(const std::filesystem::path& file, const Evaluation& evaluation,
               const std::string& title);

}  // namespace fastloop::eval
