#pragma once

#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "fastloop/map/map.hpp"

namespace fastloop::map {

/// Named texts that a caller keeps in a map file, a pending loop say.
using MapExtras = std::map<std::string, std::string>;

struct LoadedMap {
  Map map;
  MapExtras extras;
};

/// The complete map in one file, little-endian; docs/maps.md describes the format. Writing what was
/// read gives the same bytes. The file appears under its name when it is complete: a crash or a
/// full disk leaves what was there before.
/// @throws InputError naming the file when it cannot be written
void write_map_file(const std::filesystem::path& path, const Snapshot& snapshot,
                    const MapExtras& extras = {});

/// Every field as it was, to the last bit; grids and IMU integrals are computed anew from what they
/// were computed from. Ids are in range and lists have their lengths; the other invariants are
/// those of the map that was written (Map::find_inconsistency).
/// @throws InputError naming the file and what is wrong with it: not a map, of a newer version, cut
/// short, damaged
LoadedMap read_map_file(const std::filesystem::path& path);

/// Blocks of one kind in a file.
struct MapFileSection {
  std::string name;
  std::size_t blocks = 0;
  std::uint64_t bytes = 0;       ///< unpacked
  std::uint64_t file_bytes = 0;  ///< as they lie in the file
};
/// What a file is made of, in its order; reads all of it and checks the checksums.
/// @throws InputError as read_map_file
std::vector<MapFileSection> map_file_sections(const std::filesystem::path& path);

}  // namespace fastloop::map
