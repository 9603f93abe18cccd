#pragma once

#include <string>

#include "fastloop/system/loop_closing.hpp"

namespace fastloop::io {

/// One line of loops.jsonl (docs/outputs.md). With `times`, the stages' milliseconds are in it; they
/// differ from run to run.
std::string loop_record_json(const system::LoopRecord& record, bool times);

}  // namespace fastloop::io
