#pragma once

#include <cstddef>
#include <span>

#include "fastloop/features/feature_set.hpp"

namespace fastloop::map {

/// Index of the descriptor with the least median distance to all (itself included; ties: the lower
/// index). At most kMaxVoters descriptors.
inline constexpr std::size_t kMaxVoters = 24;
std::size_t typical_descriptor(std::span<const Descriptor> descriptors);

namespace reference {
/// The same by the published way: scalar distances, the median of every row.
std::size_t typical_descriptor(std::span<const Descriptor> descriptors);
}  // namespace reference

}  // namespace fastloop::map
