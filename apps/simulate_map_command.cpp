#include <cstdio>
#include <memory>
#include <nlohmann/json.hpp>

#include "commands.hpp"
#include "fastloop/loop/loop_request.hpp"
#include "fastloop/map/map_file.hpp"
#include "fastloop/sim/map_worlds.hpp"

namespace fastloop::apps {
namespace {

using Json = nlohmann::ordered_json;

Json pose_json(const SE3& T) {
  const Vector3d& t = T.translation;
  const Eigen::Quaterniond& q = T.rotation;
  return {{"translation_m", {t.x(), t.y(), t.z()}},
          {"rotation_xyzw", {q.x(), q.y(), q.z(), q.w()}}};
}

std::string truth_json(const sim::SimulatedMap& s) {
  Json expected = Json::array();
  for (const KeyframeId id : s.expected_matches) expected.push_back(id.value());
  Json j{{"keyframe", s.current.value()}, {"expected_matches", expected}};
  j["T_matched_current"] = pose_json(s.T_matched_current);
  return j.dump();
}

void simulate(const sim::MapWorldOptions& options, const std::string& file) {
  const sim::SimulatedMap s = sim::simulate_map(options);
  loop::LoopRequest request;
  request.keyframe = s.current;
  request.inertial = options.inertial;
  map::write_map_file(
      file, s.map, {{loop::kLoopRequestExtra, loop::to_json(request)}, {"truth", truth_json(s)}});
  const KeyframeId matched = s.expected_matches.front();
  std::printf("%s: %zu keyframes, %zu landmarks, %d loops closed, seed %llu\n", file.c_str(),
              s.map.num_keyframes(), s.map.num_landmarks(), options.loops,
              static_cast<unsigned long long>(options.seed));
  if (options.two_maps) {
    std::printf("pending: keyframe %u of map 1 sees the place of keyframe %u of map 0\n",
                s.current.value(), matched.value());
  } else {
    const SE3 T_mapped = s.map.T_world_body(matched).inverse() * s.map.T_world_body(s.current);
    std::printf("pending: keyframe %u sees the place of keyframe %u; drift %.3f m, %.2f deg\n",
                s.current.value(), matched.value(),
                (T_mapped.translation - s.T_matched_current.translation).norm(),
                angle_between(T_mapped, s.T_matched_current) * 180 / M_PI);
  }
}

}  // namespace

void add_simulate_map_command(CLI::App& app, int& exit_code) {
  struct Arguments {
    std::string out;
    sim::MapWorldOptions options;
  };
  auto a = std::make_shared<Arguments>();
  sim::MapWorldOptions& o = a->options;
  CLI::App* command = app.add_subcommand(
      "simulate-map", "Make a drifted map, without images, that is about to close a known loop");
  command->footer(
      "The last keyframe has come back to where the run began, but the map holds that place "
      "twice.\n"
      "The file carries the pending request (extra loop_request) and the truth (extra truth).\n"
      "Example: fastloop simulate-map --keyframes 1000 --loops 2 --out /tmp/m.flmap && "
      "fastloop map info /tmp/m.flmap");
  command->add_option("--out", a->out, "Map file to write")->required();
  command->add_option("--keyframes", o.keyframes, "Keyframes in total")
      ->check(CLI::Range(60, 1000000))
      ->capture_default_str();
  command->add_option("--covisible", o.covisible, "Keyframes that share landmarks with one, about")
      ->check(CLI::Range(8, 400))
      ->capture_default_str();
  command->add_option("--loops", o.loops, "Loops closed earlier; one more is pending")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_option("--seed", o.seed, "World, drift and noise follow from it")
      ->capture_default_str();
  command->add_option("--features", o.features, "Keypoints of a keyframe")
      ->check(CLI::Range(50, 20000))
      ->capture_default_str();
  command
      ->add_option("--drift", o.drift_scale,
                   "1: a position error of 0.3 % of the way when the loop is reached; 0: none")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  command->add_flag("--fisheye", o.fisheye, "Two fisheye cameras instead of a rectified pair");
  command->add_flag("--inertial", o.inertial,
                    "As with an initialised IMU: drift is corrected in yaw and position alone");
  command->add_flag("--two-maps", o.two_maps,
                    "Tracking was lost half way: the revisit belongs to a second map");
  command->callback([a, &exit_code] {
    simulate(a->options, a->out);
    exit_code = kExitOk;
  });
}

}  // namespace fastloop::apps
