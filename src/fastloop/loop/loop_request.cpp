#include "fastloop/loop/loop_request.hpp"

#include <nlohmann/json.hpp>

#include "fastloop/core/error.hpp"

namespace fastloop::loop {
namespace {

using Json = nlohmann::ordered_json;

Json region_json(const WaitingRegion& w) {
  const Vector3d& t = w.T_last_matched.translation;
  const Eigen::Quaterniond& q = w.T_last_matched.rotation;
  return {{"last_keyframe", w.last_keyframe.value()},
          {"matched", w.matched.value()},
          {"translation_m", {t.x(), t.y(), t.z()}},
          {"rotation_xyzw", {q.x(), q.y(), q.z(), q.w()}},
          {"confirmations", w.confirmations},
          {"misses", w.misses}};
}

WaitingRegion parse_region(const Json& j) {
  WaitingRegion w;
  w.last_keyframe = KeyframeId(j.at("last_keyframe").get<std::uint32_t>());
  w.matched = KeyframeId(j.at("matched").get<std::uint32_t>());
  const auto t = j.at("translation_m").get<std::array<double, 3>>();
  const auto q = j.at("rotation_xyzw").get<std::array<double, 4>>();
  w.T_last_matched =
      SE3(Eigen::Quaterniond(q[3], q[0], q[1], q[2]), Vector3d(t[0], t[1], t[2]));
  w.confirmations = j.at("confirmations").get<int>();
  w.misses = j.at("misses").get<int>();
  return w;
}

}  // namespace

std::string to_json(const LoopRequest& request) {
  Json j{{"keyframe", request.keyframe.value()}, {"inertial", request.inertial}};
  if (request.waiting.loop) j["waiting_loop"] = region_json(*request.waiting.loop);
  if (request.waiting.merge) j["waiting_merge"] = region_json(*request.waiting.merge);
  return j.dump();
}

LoopRequest parse_loop_request(const std::string& text) {
  try {
    const Json j = Json::parse(text);
    LoopRequest request;
    request.keyframe = KeyframeId(j.at("keyframe").get<std::uint32_t>());
    request.inertial = j.value("inertial", false);
    if (j.contains("waiting_loop")) request.waiting.loop = parse_region(j["waiting_loop"]);
    if (j.contains("waiting_merge")) request.waiting.merge = parse_region(j["waiting_merge"]);
    return request;
  } catch (const Json::exception& e) {
    throw InvalidArgument(std::string("not a loop request: ") + e.what());
  }
}

}  // namespace fastloop::loop
