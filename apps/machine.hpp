#pragma once

#include <string>

#include "fastloop/io/run_output.hpp"

namespace fastloop::apps {

/// Text after "key :" of the first such line in a file of /proc; empty when there is none.
std::string proc_value(const char* file, const std::string& key);

/// This computer, and how and from which commit the program was built.
io::MachineFacts machine_facts();

/// "2026-11-23 08:15 UTC".
std::string utc_now();

}  // namespace fastloop::apps
