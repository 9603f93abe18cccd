#include "fastloop/io/run_output.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <functional>
#include <nlohmann/json.hpp>

#include "fastloop/core/error.hpp"
#include "fastloop/io/loops_json.hpp"
#include "fastloop/io/trajectory.hpp"

namespace fastloop::io {
namespace {

using Json = nlohmann::ordered_json;

void write_file(const std::filesystem::path& path, const std::string& content) {
  std::ofstream out(path, std::ios::binary);
  out << content;
  out.close();
  if (!out)
    throw InputError({path.string(), 0, ""}, "cannot be written completely",
                     "enough space and permission");
}

/// Carries on after a file that could not be written, so that it does not take the others along.
class Attempts {
 public:
  void run(const std::function<void()>& step) {
    try {
      step();
    } catch (const InputError&) {
      if (!failure_) failure_ = std::current_exception();
    }
  }
  /// Throws the first failure, if there was one.
  void finish() const {
    if (failure_) std::rethrow_exception(failure_);
  }

 private:
  std::exception_ptr failure_;
};

std::vector<StampedPose> collect(
    const system::System& system,
    const std::function<std::optional<SE3>(const system::FrameRecord&)>& pose_of) {
  std::vector<StampedPose> poses;
  for (const system::FrameRecord& f : system.frames())
    if (const auto pose = pose_of(f)) poses.push_back({f.stamp_ns, *pose});
  return poses;
}

void write_trajectories(const std::filesystem::path& folder, const system::System& system,
                        const RunFacts& facts, Attempts& attempts) {
  const auto write = [&](const char* name, const std::vector<StampedPose>& poses) {
    attempts.run([&] { write_tum(folder / name, poses); });
  };
  const auto final_pose = [&](const system::FrameRecord& f) { return system.T_world_body(f); };
  write("trajectory_body.txt", collect(system, final_pose));
  write("trajectory_cam0.txt", collect(system, [&](const auto& f) -> std::optional<SE3> {
          const auto pose = final_pose(f);
          return pose ? std::optional<SE3>(*pose * facts.T_body_cam0) : std::nullopt;
        }));
  write("trajectory_live.txt", collect(system, [](const auto& f) -> std::optional<SE3> {
          return f.has_pose ? std::optional<SE3>(f.live_T_world_body) : std::nullopt;
        }));
  const auto map = system.snapshot();
  std::vector<StampedPose> keyframes;
  for (std::uint32_t i = 0; i < map->keyframe_slots(); ++i)
    if (map->contains(KeyframeId(i)))
      keyframes.push_back(
          {map->keyframe(KeyframeId(i)).data->stamp_ns, map->T_world_body(KeyframeId(i))});
  write("keyframes.txt", keyframes);
}

void write_map_ply(const std::filesystem::path& path, const map::Snapshot& map) {
  std::string body;
  std::size_t count = 0;
  char line[96];
  for (std::uint32_t i = 0; i < map.landmark_slots(); ++i) {
    if (!map.contains(LandmarkId(i))) continue;
    const Vector3d p = map.p_world(LandmarkId(i));
    std::snprintf(line, sizeof line, "%.4f %.4f %.4f\n", p.x(), p.y(), p.z());
    body += line;
    ++count;
  }
  write_file(path,
             "ply\nformat ascii 1.0\ncomment landmarks, metres, world frame\nelement vertex " +
                 std::to_string(count) +
                 "\nproperty float x\nproperty float y\nproperty float z\nend_header\n" + body);
}

void write_events(const std::filesystem::path& path, const system::System& system) {
  std::string text;
  for (const system::Event& e : system.events()) {
    Json j;
    j["t"] = format_seconds(e.stamp_ns);
    j["event"] = e.kind;
    j["reason"] = e.reason;
    if (e.T_new_old) {
      const auto& t = e.T_new_old->translation;
      const auto& q = e.T_new_old->rotation;
      j["map_correction"] = {{"translation_m", {t.x(), t.y(), t.z()}},
                             {"rotation_xyzw", {q.x(), q.y(), q.z(), q.w()}}};
    }
    text += j.dump() + "\n";
  }
  write_file(path, text);
}

void write_loops(const std::filesystem::path& path, const system::System& system) {
  std::string text;
  for (const system::LoopRecord& record : system.loops())
    text += loop_record_json(record, !system.deterministic()) + "\n";
  write_file(path, text);
}

/// Whether a correction delays tracking: frames within two seconds of one against all others.
Json tracking_around_loops(const system::System& system) {
  constexpr Nanoseconds kAround = 2'000'000'000;
  std::vector<Nanoseconds> loops;
  for (const system::LoopRecord& r : system.loops())
    if (r.correction && r.correction->applied) loops.push_back(r.report.stamp_ns);
  std::vector<double> around, elsewhere;
  for (const system::FrameRecord& f : system.frames()) {
    const bool near = std::any_of(loops.begin(), loops.end(), [&](Nanoseconds t) {
      return std::abs(f.stamp_ns - t) <= kAround;
    });
    (near ? around : elsewhere).push_back(f.tracking_ms);
  }
  const StageStatistics a = summarize(around), e = summarize(elsewhere);
  return {{"frames", a.count},
          {"worst_ms", a.max_ms},
          {"p99_elsewhere_ms", e.p99_ms},
          {"worst_elsewhere_ms", e.max_ms}};
}

/// Time of each frame's tracking, in short numbers: microseconds are below what can be repeated.
Json tracking_by_frame(const system::System& system) {
  const auto rounded = [](double v) { return std::round(v * 1e3) / 1e3; };
  Json t = Json::array(), ms = Json::array();
  for (const system::FrameRecord& f : system.frames()) {
    t.push_back(rounded(to_seconds(f.stamp_ns - system.frames().front().stamp_ns)));
    ms.push_back(rounded(f.tracking_ms));
  }
  return {{"t_s", t}, {"ms", ms}};
}

Json memory_json(const RunFacts& facts) {
  Json samples = Json::array();
  for (const MemorySample& m : facts.memory)
    samples.push_back({{"t_s", m.t_s},
                       {"wall_s", m.wall_s},
                       {"resident_mib", m.resident_mib},
                       {"keyframes", m.keyframes},
                       {"landmarks", m.landmarks}});
  return {{"peak_mib", facts.peak_mib}, {"samples", samples}};
}

Json device_json(const std::optional<CudaCounters>& c) {
  if (!c) return nullptr;
  const auto mib = [](std::uint64_t bytes) { return static_cast<double>(bytes) / (1 << 20); };
  return {{"peak_mib", mib(c->reserved_bytes)},
          {"to_device_mib", mib(c->bytes_to_device)},
          {"to_host_mib", mib(c->bytes_to_host)},
          {"launches", c->launches},
          {"waits", c->synchronizations}};
}

Json machine_json(const MachineFacts& m) {
  return {{"cpu", m.cpu},           {"cores", m.cores}, {"memory_gib", m.memory_gib},
          {"compiler", m.compiler}, {"build", m.build}, {"commit", m.commit}};
}

void write_timing(const std::filesystem::path& path, const system::System& system,
                  const RunFacts& facts) {
  Json stages = Json::object();
  for (const auto& [name, s] : system.times().statistics())
    stages[name] = {{"count", s.count},   {"mean_ms", s.mean_ms}, {"p50_ms", s.p50_ms},
                    {"p95_ms", s.p95_ms}, {"p99_ms", s.p99_ms},   {"max_ms", s.max_ms}};
  Json j;
  j["stages"] = stages;
  j["wall_seconds"] = facts.wall_seconds;
  j["fps"] =
      facts.wall_seconds > 0 ? static_cast<double>(system.frames().size()) / facts.wall_seconds : 0;
  // Medians of tracking over five equal parts of the sequence: flat unless the map slows tracking
  // down.
  const std::vector<double> samples = system.times().samples("track_total");
  Json fifths = Json::array();
  for (std::size_t part = 0; part < 5; ++part) {
    const auto begin = samples.begin() + static_cast<std::ptrdiff_t>(samples.size() * part / 5);
    const auto end = samples.begin() + static_cast<std::ptrdiff_t>(samples.size() * (part + 1) / 5);
    fifths.push_back(summarize({begin, end}).p50_ms);
  }
  j["track_p50_ms_by_fifth"] = fifths;
  j["track_around_loops"] = tracking_around_loops(system);
  j["memory"] = memory_json(facts);
  j["device"] = device_json(facts.device);
  j["machine"] = machine_json(facts.machine);
  j["first_stamp_ns"] = system.frames().empty() ? 0 : system.frames().front().stamp_ns;
  j["track_by_frame"] = tracking_by_frame(system);
  write_file(path, j.dump(2) + "\n");
}

void write_summary(const std::filesystem::path& path, const system::System& system,
                   const RunFacts& facts) {
  const RunSummary s = summarize_run(system);
  Json j;
  j["version"] = "0.1.0";
  j["dataset"] = facts.dataset;
  j["mode"] = system::to_string(system.mode());
  j["state"] =
      system.frames().empty() ? "no frames" : tracking::to_string(system.frames().back().state);
  j["frames"] = s.frames;
  j["frames_tracked"] = s.tracked;
  j["tracked_percent"] =
      s.frames ? 100.0 * static_cast<double>(s.tracked) / static_cast<double>(s.frames) : 0.0;
  j["tracked_percent_since_initialised"] =
      s.frames_since_start ? 100.0 * static_cast<double>(s.tracked_since_start) /
                                 static_cast<double>(s.frames_since_start)
                           : 0.0;
  j["dropped_frames"] = facts.frames_dropped;
  j["keyframes"] = s.keyframes;
  j["landmarks"] = s.landmarks;
  j["maps"] = s.maps;
  j["loops_closed"] = s.loops;
  j["maps_merged"] = s.merges;
  j["imu_initialized"] = system.imu_initialized();
  j["seconds"] =
      system.frames().empty()
          ? 0.0
          : to_seconds(system.frames().back().stamp_ns - system.frames().front().stamp_ns);
  j["interrupted"] = facts.interrupted;
  j["remarks"] = facts.remarks;
  j["ground_truth"] = facts.ground_truth.empty() ? Json() : Json(facts.ground_truth);
  write_file(path, j.dump(2) + "\n");
}

}  // namespace

RunSummary summarize_run(const system::System& system) {
  RunSummary s;
  s.frames = system.frames().size();
  bool started = false;
  for (const system::FrameRecord& f : system.frames()) {
    const bool tracked = f.state == tracking::State::kTracking;
    started |= tracked;
    s.tracked += tracked;
    s.frames_since_start += started;
    s.tracked_since_start += started && tracked;
  }
  const auto map = system.snapshot();
  s.keyframes = map->num_keyframes();
  s.landmarks = map->num_landmarks();
  for (const map::MapInfo& info : map->maps()) s.maps += !info.merged_into.valid();
  for (const system::LoopRecord& record : system.loops())
    if (record.correction && record.correction->applied) ++(record.merge ? s.merges : s.loops);
  return s;
}

void prepare_output_folder(const std::filesystem::path& folder) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  if (error || !std::filesystem::is_directory(folder))
    throw InputError({folder.string(), 0, ""}, "output folder cannot be created",
                     "a writable folder");
  const std::filesystem::path probe = folder / ".write_test";
  try {
    write_file(probe, "x");
  } catch (const InputError&) {
    throw InputError({folder.string(), 0, ""}, "output folder is not writable",
                     "a writable folder");
  }
  std::filesystem::remove(probe, error);
}

void write_run_output(const std::filesystem::path& folder, const system::System& system,
                      const RunFacts& facts) {
  Attempts attempts;
  write_trajectories(folder, system, facts, attempts);
  attempts.run([&] { write_map_ply(folder / "map.ply", *system.snapshot()); });
  attempts.run([&] { write_events(folder / "events.jsonl", system); });
  attempts.run([&] { write_loops(folder / "loops.jsonl", system); });
  attempts.run([&] { write_timing(folder / "timing.json", system, facts); });
  attempts.run([&] { write_summary(folder / "summary.json", system, facts); });
  attempts.finish();
}

}  // namespace fastloop::io
