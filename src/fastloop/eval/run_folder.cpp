#include "fastloop/eval/run_folder.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

#include "fastloop/core/error.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::eval {
namespace {

namespace fs = std::filesystem;

/// Calls `use` with what is in a file, and says where it was when that fails.
template <class Use>
void with_json(const fs::path& file, int line, const std::string& text, const Use& use) {
  try {
    use(Json::parse(text));
  } catch (const Json::exception& e) {
    throw InputError({file.string(), line, ""},
                     std::string("not as fastloop run writes it: ") + e.what());
  }
}

template <class Use>
void for_each_line(const fs::path& file, const Use& use) {
  std::istringstream in(io::read_text_file(file));
  int number = 0;
  for (std::string line; std::getline(in, line);) {
    ++number;
    if (!line.empty()) with_json(file, number, line, use);
  }
}

Nanoseconds stamp_of(const Json& j) {
  const auto stamp = io::parse_decimal(j.at("t").get<std::string>(), 9);
  if (!stamp) throw InvalidArgument("a time stamp cannot be read");
  return *stamp;
}

RunLoop loop_of(const Json& j) {
  RunLoop loop;
  loop.stamp_ns = stamp_of(j);
  loop.keyframe = j.at("keyframe").get<unsigned>();
  loop.reason = j.at("reason").get<std::string>();
  const Json& c = j.at("correction");
  loop.applied = c.at("applied").get<bool>();
  loop.merge = c.at("kind").get<std::string>() == "merge";
  loop.keyframes_moved = c.at("keyframes_moved").get<std::size_t>();
  loop.landmarks_joined = c.at("landmarks_joined").get<std::size_t>();
  loop.observations_added = c.at("observations_added").get<std::size_t>();
  if (j.contains("times_ms"))
    for (const auto& [stage, ms] : j.at("times_ms").items())
      loop.stages_ms.emplace_back(stage, ms.get<double>());
  return loop;
}

/// Poses of a trajectory file, none when nothing was tracked.
std::vector<io::StampedPose> poses_of(const fs::path& file) {
  if (io::trimmed(io::read_text_file(file)).empty()) return {};
  return io::read_trajectory(file).poses;
}

}  // namespace

std::vector<RunLoop> RunFolder::applied(bool merge) const {
  std::vector<RunLoop> result;
  for (const RunLoop& loop : loops)
    if (loop.applied && loop.merge == merge) result.push_back(loop);
  return result;
}

std::vector<double> RunFolder::tracking_around_loops_ms(double around_s) const {
  std::vector<double> result;
  if (!timing.contains("track_by_frame")) return result;
  const auto t = timing.at("track_by_frame").at("t_s").get<std::vector<double>>();
  const auto ms = timing.at("track_by_frame").at("ms").get<std::vector<double>>();
  const double first_s = timing.at("first_stamp_ns").get<std::int64_t>() * 1e-9;
  for (std::size_t i = 0; i < std::min(t.size(), ms.size()); ++i) {
    const bool near = std::any_of(loops.begin(), loops.end(), [&](const RunLoop& loop) {
      return loop.applied && std::abs(to_seconds(loop.stamp_ns) - first_s - t[i]) <= around_s;
    });
    if (near) result.push_back(ms[i]);
  }
  return result;
}

RunFolder read_run_folder(const fs::path& folder) {
  RunFolder run;
  run.path = folder;
  const auto whole = [&](const char* name, Json& target) {
    const fs::path file = folder / name;
    with_json(file, 0, io::read_text_file(file), [&](Json j) { target = std::move(j); });
  };
  whole("summary.json", run.summary);
  whole("timing.json", run.timing);
  for_each_line(folder / "events.jsonl", [&](const Json& j) {
    run.events.push_back(
        {stamp_of(j), j.at("event").get<std::string>(), j.at("reason").get<std::string>()});
  });
  for_each_line(folder / "loops.jsonl", [&](const Json& j) {
    if (j.contains("correction"))
      run.loops.push_back(loop_of(j));
    else
      ++run.refused_candidates;
  });
  run.final_poses = poses_of(folder / "trajectory_body.txt");
  run.live_poses = poses_of(folder / "trajectory_live.txt");
  return run;
}

std::optional<std::string> check_stage_sums(const RunFolder& run) {
  const Json& stages = run.timing.at("stages");
  if (!stages.contains("loop_close")) return std::nullopt;
  const double measured = stages.at("loop_close").at("mean_ms").get<double>() *
                          stages.at("loop_close").at("count").get<double>();
  StageList sums;
  for (const RunLoop& loop : run.loops)
    for (const auto& [stage, ms] : loop.stages_ms)
      if (!stage.starts_with("apply_")) sums.emplace_back(stage, ms);  // the owner of the map does
  if (sums.empty()) return std::nullopt;
  return sum_mismatch(sums, measured);
}

}  // namespace fastloop::eval
