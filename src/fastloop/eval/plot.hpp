#pragma once

#include <filesystem>
#include <string>

#include "fastloop/eval/evaluation.hpp"

namespace fastloop::eval {

/// Picture of an evaluation (SVG): both trajectories seen along the axis in which the reference
/// moves least (from above, as a rule), the error over time, and the numbers.
std::string to_svg(const Evaluation& evaluation, const std::string& title);

/// @throws InputError naming the file when it cannot be written completely
void write_svg(const std::filesystem::path& file, const Evaluation& evaluation,
               const std::string& title);

}  // namespace fastloop::eval
