#pragma once

#include <filesystem>
#include <string>

#include "fastloop/system/system.hpp"

namespace fastloop::io {

/// Reads options of the system from YAML: groups `orb`, `tracking`, `mapping`, keys named as the
/// fields of OrbOptions, TrackingOptions and MappingOptions. Only what differs from the defaults
/// need be given.
/// @throws InputError naming file, line and key: unknown keys, wrong types, values out of range
void load_options(const std::filesystem::path& file, system::SystemOptions& options);

/// The same from text; `name` stands for the file in messages.
void parse_options(const std::string& text, const std::string& name,
                   system::SystemOptions& options);

}  // namespace fastloop::io
