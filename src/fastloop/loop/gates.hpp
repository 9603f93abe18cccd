#pragma once

#include <optional>
#include <string>

#include "fastloop/loop/options.hpp"
#include "fastloop/loop/region_match.hpp"
#include "fastloop/loop/report.hpp"
#include "fastloop/map/snapshot.hpp"

namespace fastloop::loop {

/// Length of the way from one keyframe to a later one along the keyframes between them, metres.
double path_length_m(const map::Snapshot& snapshot, KeyframeId from, KeyframeId to);

/// Compares the correction that a match demands with what is possible: tilt and yaw where gravity is
/// known, drift of the odometry for a loop. Where gravity is known the match is turned about the
/// vertical only from then on.
/// @param[in,out] match   T_camera_world loses its tilt
/// @param[in,out] report  gets the readings
/// @return reason to refuse, if any
std::optional<std::string> check_motion(const map::Snapshot& snapshot, const LoopOptions& options,
                                        RegionMatch& match, CandidateReport& report);

}  // namespace fastloop::loop
