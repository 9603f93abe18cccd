#pragma once

#include <span>
#include <vector>

#include "fastloop/loop/fusion.hpp"
#include "fastloop/map/essential_graph.hpp"

namespace fastloop::loop {

/// Pairs of keyframes that a fusion connects: one end is in `connected`, the other is not, and they
/// share at least `min_shared` landmarks from now on, which they did not before.
///
/// Two ways to the same result, ordered by (a, b) with a in `connected`. The incremental one adds up
/// what each merge and each new observation changes; the reference counts the landmarks of every
/// connected keyframe before the fusion and again after it, as published.
std::vector<map::LoopConnection> find_connections(const map::Snapshot& snapshot,
                                                  std::span<const KeyframeId> connected,
                                                  const Fusion& fusion, int min_shared);
std::vector<map::LoopConnection> find_connections_reference(const map::Snapshot& snapshot,
                                                            std::span<const KeyframeId> connected,
                                                            const Fusion& fusion, int min_shared);

}  // namespace fastloop::loop
