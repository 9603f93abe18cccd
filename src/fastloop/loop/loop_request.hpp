#pragma once

#include <string>

#include "fastloop/loop/detection.hpp"

namespace fastloop::loop {

/// What, together with a map, is needed to run loop closing for one keyframe again.
struct LoopRequest {
  KeyframeId keyframe;
  bool inertial = false;
  LoopDetector::Waiting waiting;
};

/// Name under which a map file carries a request.
inline constexpr const char* kLoopRequestExtra = "loop_request";

std::string to_json(const LoopRequest& request);
/// @throws InvalidArgument when the text is not a request
LoopRequest parse_loop_request(const std::string& json);

}  // namespace fastloop::loop
