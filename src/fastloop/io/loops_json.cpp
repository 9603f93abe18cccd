#include "fastloop/io/loops_json.hpp"

#include <nlohmann/json.hpp>

#include "fastloop/io/trajectory.hpp"

namespace fastloop::io {
namespace {

using Json = nlohmann::ordered_json;

Json candidate_json(const loop::CandidateReport& c) {
  Json j;
  j["keyframe"] = c.keyframe.value();
  j["kind"] = c.merge ? "merge" : "loop";
  if (c.recheck) j["recheck"] = true;
  if (!c.recheck) {
    j["score"] = c.score;
    j["shared_words"] = c.shared_words;
    j["descriptor_matches"] = c.descriptor_matches;
  }
  Json gates = Json::array();
  for (const loop::GateReading& g : c.gates)
    gates.push_back({{"gate", g.gate}, {"value", g.value}, {"threshold", g.threshold}, {"passed", g.passed}});
  j["gates"] = gates;
  j["verdict"] = loop::to_string(c.verdict);
  j["reason"] = c.reason;
  if (c.measured) {
    const SE3& T = c.measured->T_matched_current;
    const Vector3d& t = T.translation;
    const Eigen::Quaterniond& q = T.rotation;
    j["matched_t"] = format_seconds(c.measured->matched_stamp_ns);
    j["T_matched_current"] = {t.x(), t.y(), t.z(), q.x(), q.y(), q.z(), q.w()};
  }
  return j;
}

}  // namespace

std::string loop_record_json(const system::LoopRecord& record, bool times) {
  const loop::LoopReport& r = record.report;
  Json j;
  j["t"] = format_seconds(r.stamp_ns);
  j["keyframe"] = r.keyframe.value();
  j["verdict"] = loop::to_string(r.verdict);
  j["reason"] = r.reason;
  j["candidates"] = Json::array();
  for (const loop::CandidateReport& c : r.candidates) j["candidates"].push_back(candidate_json(c));
  if (record.correction) {
    const map::CorrectionOutcome& o = *record.correction;
    j["correction"] = {{"kind", record.merge ? "merge" : "loop"},
                       {"applied", o.applied},
                       {"keyframes_moved", o.moved},
                       {"landmarks_joined", o.merged},
                       {"observations_added", o.observed}};
  }
  j["backend"] = loop::to_string(record.backend);
  if (times) {
    Json stages;
    for (const auto& [stage, ms] : r.times_ms) stages[stage] = ms;
    if (record.correction) {
      const map::CorrectionOutcome::Times& t = record.correction->times;
      stages["apply_check"] = t.check_ms;
      stages["apply_poses"] = t.poses_ms;
      stages["apply_landmarks"] = t.landmarks_ms;
      stages["apply_covisibility"] = t.covisibility_ms;
    }
    j["times_ms"] = stages;
  }
  return j.dump();
}

}  // namespace fastloop::io
