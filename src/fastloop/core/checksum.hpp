#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace fastloop {

/// CRC-64/XZ, which finds every damage of up to 64 neighbouring bits and nearly all others.
/// @param previous  of the bytes before, to continue; 0 at the start
std::uint64_t crc64(std::span<const std::byte> bytes, std::uint64_t previous = 0);

}  // namespace fastloop
