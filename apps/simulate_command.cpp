#include <unistd.h>

#include <cstdio>
#include <memory>
#include <string>

#include "commands.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/sim/sequence_writer.hpp"

namespace fastloop::apps {
namespace {

struct SimulateArguments {
  std::string world, camera, out, motion, imu;
  double seconds = 0;
  std::uint64_t seed = 1;
  int threads = 0;
};

sim::SequenceOptions sequence_options(const SimulateArguments& a) {
  sim::SequenceOptions options;
  options.world = sim::parse_world_kind(a.world);
  const bool fisheye_by_default = options.world == sim::WorldKind::kCorridor;
  options.camera = a.camera.empty() ? (fisheye_by_default ? sim::CameraKind::kFisheye : sim::CameraKind::kPinhole)
                                    : sim::parse_camera_kind(a.camera);
  options.seconds = a.seconds;
  options.seed = a.seed;
  if (!a.motion.empty()) options.motion = a.motion;
  if (!a.imu.empty()) options.recorded_imu = a.imu;
  return options;
}

int simulate(const SimulateArguments& a) {
  const sim::SimulatedSequence sequence(sequence_options(a));
  for (const std::string& remark : sequence.remarks()) std::fprintf(stderr, "note: %s\n", remark.c_str());
  sim::WriteOptions write;
  write.folder = a.out;
  write.threads = a.threads;
  const bool terminal = isatty(STDERR_FILENO) != 0;
  if (terminal)
    write.progress = [](std::size_t done, std::size_t total) {
      std::fprintf(stderr, "\r%zu / %zu frames%s", done, total, done == total ? "\n" : "");
    };
  const Stopwatch watch;
  sim::write_sequence(sequence, write);
  const double seconds = watch.elapsed_ms() / 1000;
  std::printf("%s: %zu frames, %.1f s of %s %s, seed %llu; written in %.1f s (%.1f frames/s)\n", a.out.c_str(),
              sequence.size(), sequence.options().seconds, a.motion.empty() ? a.world.c_str() : "recorded motion",
              sim::to_string(sequence.options().camera).c_str(), static_cast<unsigned long long>(a.seed), seconds,
              static_cast<double>(sequence.size()) / seconds);
  return kExitOk;
}

}  // namespace

void add_simulate_command(CLI::App& app, int& exit_code) {
  auto a = std::make_shared<SimulateArguments>();
  CLI::App* command = app.add_subcommand("simulate", "Make a synthetic sequence with exact ground truth");
  command->footer(
      "Worlds: room (8 x 6 m, 40 s), hall (25 x 15 m, 90 s), corridor (214 m circuit, 160 s, fisheye),\n"
      "campus (streets, 1.1 km, 300 s), ring (63 m around, 64 s), cloister (a ring of bays that look alike, 120 s). The folder is an EuRoC recording (mav0/...), or a TUM RGB-D one for\n"
      "--camera rgbd. The same seed gives the same bytes.\n"
      "Example: fastloop simulate room --out /tmp/room --seconds 20 --seed 3");
  command->add_option("world", a->world, "room, hall, corridor, campus, ring or cloister")
      ->required()
      ->check(CLI::IsMember({"room", "hall", "corridor", "campus", "ring", "cloister"}));
  command->add_option("--out", a->out, "Folder to write; must be new, empty or an earlier simulation")->required();
  command->add_option("--seconds", a->seconds, "Length; default: the usual length of the world")
      ->check(CLI::Range(0.1, 7200.0));
  command->add_option("--seed", a->seed, "Of world, motion and noise")->capture_default_str();
  command->add_option("--camera", a->camera, "pinhole, fisheye (both stereo with IMU) or rgbd; default: pinhole, corridor: fisheye")
      ->check(CLI::IsMember({"pinhole", "fisheye", "rgbd"}));
  CLI::Option* motion = command->add_option(
      "--motion", a->motion, "Fly this recorded body trajectory (EuRoC csv or TUM) in a world built around it");
  command->add_option("--imu", a->imu, "Recorded IMU of that motion (EuRoC imu0/data.csv), copied instead of a synthetic one")
      ->needs(motion);
  command->add_option("--threads", a->threads, "0 = all cores")->check(CLI::Range(0, 1024));
  command->callback([a, &exit_code] { exit_code = simulate(*a); });
}

}  // namespace fastloop::apps
