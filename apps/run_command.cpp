#include <unistd.h>

#include <atomic>
#include <csignal>
#include <iostream>
#include <memory>
#include <thread>

#include "commands.hpp"
#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/core/bounded_queue.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/core/logging.hpp"
#include "fastloop/core/process_memory.hpp"
#include "fastloop/io/dataset.hpp"
#include "fastloop/io/options_yaml.hpp"
#include "fastloop/io/run_output.hpp"
#include "fastloop/map/map_file.hpp"
#include "fastloop/system/system.hpp"
#include "machine.hpp"

namespace fastloop::apps {
namespace {

std::atomic<bool> interrupted{false};

struct RunArguments {
  std::string dataset, out, mode = "auto", config, calibration;
  std::string backend = "auto", record_loops, save_map, load_map;
  bool deterministic = false, realtime = false, no_loop = false, no_merge = false, quiet = false,
       localize = false;
  std::size_t max_frames = 0;
  double start_s = 0;
};

system::Mode parse_mode(const std::string& name) {
  for (const auto mode : {system::Mode::kAuto, system::Mode::kStereo, system::Mode::kStereoInertial,
                          system::Mode::kRgbd})
    if (name == system::to_string(mode)) return mode;
  throw InvalidArgument("unknown mode " + name);
}

/// Decodes images ahead of tracking in a thread of its own. Errors arrive with the frame they
/// concern.
class Prefetcher {
 public:
  struct Item {
    std::size_t index = 0;
    FrameInput frame;
    std::exception_ptr error;
  };
  Prefetcher(const io::Dataset& dataset, std::size_t begin, std::size_t end)
      : queue_(4), thread_([this, &dataset, begin, end] {
          for (std::size_t i = begin; i < end; ++i) {
            Item item;
            item.index = i;
            try {
              item.frame = dataset.load(i);
            } catch (...) {
              item.error = std::current_exception();
            }
            const bool failed = item.error != nullptr;
            if (!queue_.push(std::move(item)) || failed) break;
          }
          queue_.close();
        }) {}
  ~Prefetcher() { queue_.close(); }
  std::optional<Item> next() { return queue_.pop(); }

 private:
  BoundedQueue<Item> queue_;
  std::jthread thread_;
};

/// One line that is rewritten on a terminal; a line every few seconds otherwise.
class Progress {
 public:
  Progress(std::size_t total, bool quiet)
      : total_(total), quiet_(quiet), terminal_(isatty(STDERR_FILENO) != 0) {}
  void update(const system::System& system, bool last) {
    const double now = watch_.elapsed_ms() / 1e3;
    if (quiet_ || (!last && now - shown_ < (terminal_ ? 0.2 : 5.0))) return;
    shown_ = now;
    const auto& f = system.frames().back();
    const auto map = system.snapshot();
    std::fprintf(stderr, "%s%zu/%zu frames  %.1f fps  %s  %zu keyframes  %zu landmarks%s",
                 terminal_ ? "\r" : "", system.frames().size(), total_,
                 static_cast<double>(system.frames().size()) / now, tracking::to_string(f.state),
                 map->num_keyframes(), map->num_landmarks(), terminal_ && !last ? "   " : "\n");
  }

 private:
  std::size_t total_;
  bool quiet_, terminal_;
  Stopwatch watch_;
  double shown_ = -10;
};

/// Memory and size of the map, once a second and at the end.
class MemoryLog {
 public:
  void update(const system::System& system, bool last, io::RunFacts& facts) {
    const double now = watch_.elapsed_ms() / 1e3;
    if (system.frames().empty() || (!last && now - sampled_ < 1.0)) return;
    sampled_ = now;
    const auto map = system.snapshot();
    const ProcessMemory memory = process_memory();
    facts.peak_mib = memory.peak_mib;
    facts.memory.push_back(
        {to_seconds(system.frames().back().stamp_ns - system.frames().front().stamp_ns), now,
         memory.resident_mib, map->num_keyframes(), map->num_landmarks()});
  }

 private:
  Stopwatch watch_;
  double sampled_ = -10;
};

/// Index of the first frame at or after the start time.
std::size_t first_frame(const io::Dataset& dataset, double start_s) {
  std::size_t i = 0;
  while (i < dataset.size() && to_seconds(dataset.stamp_ns(i) - dataset.stamp_ns(0)) < start_s) ++i;
  if (i == dataset.size()) throw InvalidArgument("--start lies behind the end of the data set");
  return i;
}

/// Feeds the frames; with `realtime` at the recorded pace, dropping what comes too late.
void feed(const io::Dataset& dataset, system::System& system, const RunArguments& args,
          io::RunFacts& facts) {
  const std::size_t begin = first_frame(dataset, args.start_s);
  const std::size_t end =
      args.max_frames ? std::min(dataset.size(), begin + args.max_frames) : dataset.size();
  facts.frames_available = end - begin;
  Progress progress(end - begin, args.quiet);
  MemoryLog memory;
  Prefetcher prefetcher(dataset, begin, end);
  std::size_t fed = begin;  ///< index of the last frame that was processed
  const auto start = std::chrono::steady_clock::now();
  while (auto item = prefetcher.next()) {
    if (interrupted) break;
    if (item->error) std::rethrow_exception(item->error);
    if (args.realtime) {
      const auto due =
          start + std::chrono::nanoseconds(item->frame.stamp_ns - dataset.stamp_ns(begin));
      const auto period = std::chrono::nanoseconds(
          item->index > begin ? item->frame.stamp_ns - dataset.stamp_ns(item->index - 1) : 0);
      std::this_thread::sleep_until(due);
      if (std::chrono::steady_clock::now() > due + period && item->index > begin) {
        ++facts.frames_dropped;
        continue;
      }
    }
    // Measurements belong to the time since the last processed frame; before the first one nothing
    // is known.
    if (item->index == begin || item->index > fed + 1)
      item->frame.imu = dataset.imu_between(dataset.stamp_ns(fed), item->frame.stamp_ns);
    fed = item->index;
    system.process(item->frame);
    progress.update(system, false);
    memory.update(system, false, facts);
  }
  system.finish();
  if (!system.frames().empty()) progress.update(system, true);
  memory.update(system, true, facts);
  facts.device = CudaSession::process_wide_counters();
}

int run(const RunArguments& args) {
  io::OpenOptions open;
  if (!args.calibration.empty()) open.calibration = args.calibration;
  const auto dataset = io::open_dataset(args.dataset, open);
  io::prepare_output_folder(args.out);
  if (!args.record_loops.empty()) io::prepare_output_folder(args.record_loops);
  for (const std::string& remark : dataset->remarks()) logger("io").warn("{}", remark);

  system::SystemOptions options;
  if (!args.config.empty()) io::load_options(args.config, options);
  options.mode = parse_mode(args.mode);
  options.deterministic = args.deterministic;
  options.drop_when_busy = args.realtime;
  options.loops.enabled = !args.no_loop;
  options.loops.record_folder = args.record_loops;
  options.loops.loop.merge_maps = !args.no_merge;
  options.loops.backend = loop::parse_backend(args.backend);
  if (args.localize && args.load_map.empty()) throw InvalidArgument("--localize needs --load-map");
  if (!args.load_map.empty())
    options.initial_map = map::read_map_file(args.load_map).map.publish();
  options.localize_only = args.localize;
  system::System system(dataset->calibration(), options);
  io::RunFacts facts;
  facts.dataset = std::filesystem::path(args.dataset).filename().string();
  facts.remarks = dataset->remarks();
  if (const auto truth = dataset->ground_truth())
    facts.ground_truth = std::filesystem::absolute(*truth).string();
  facts.machine = machine_facts();
  facts.T_body_cam0 = dataset->calibration().cameras[0].T_body_camera;

  std::signal(SIGINT, [](int) { interrupted = true; });
  std::signal(SIGTERM, [](int) { interrupted = true; });
  const Stopwatch watch;
  std::exception_ptr failure;
  try {
    feed(*dataset, system, args, facts);
  } catch (const InputError&) {
    // A file that cannot be read ends the run; what was tracked until then is saved all the same.
    failure = std::current_exception();
    system.finish();
  }
  facts.wall_seconds = watch.elapsed_ms() / 1e3;
  facts.interrupted = interrupted;
  io::write_run_output(args.out, system, facts);
  if (!args.save_map.empty()) map::write_map_file(args.save_map, *system.snapshot());
  if (failure) std::rethrow_exception(failure);

  const io::RunSummary s = io::summarize_run(system);
  std::printf(
      "%zu frames, %.1f %% tracked, %zu keyframes, %zu landmarks, %zu map%s, %.1f s; results in "
      "%s\n",
      s.frames,
      s.frames ? 100.0 * static_cast<double>(s.tracked) / static_cast<double>(s.frames) : 0.0,
      s.keyframes, s.landmarks, s.maps, s.maps == 1 ? "" : "s", facts.wall_seconds,
      args.out.c_str());
  return s.tracked > 0 ? kExitOk : kExitNeverInitialised;
}

}  // namespace

void add_run_command(CLI::App& app, int& exit_code) {
  auto args = std::make_shared<RunArguments>();
  CLI::App* command =
      app.add_subcommand("run", "Run SLAM on a data set folder and write trajectory and map");
  command->add_option("dataset", args->dataset, "EuRoC, TUM-VI, TUM RGB-D or KITTI odometry folder")
      ->required();
  command->add_option("--out", args->out, "Folder for the results; created when missing")
      ->required();
  command->add_option("--mode", args->mode, "Sensors to use")
      ->check(CLI::IsMember({"auto", "stereo", "stereo-inertial", "rgbd"}))
      ->capture_default_str();
  command->add_option(
      "--calib", args->calibration,
      "Calibration file that replaces the data set's own (own YAML, Kalibr, ORB-SLAM3)");
  command->add_option("--config", args->config,
                      "YAML with options that differ from the defaults (docs/options.md)");
  command->add_flag("--deterministic", args->deterministic,
                    "Tracking and mapping in one thread, with the same result (only --realtime "
                    "depends on the clock)");
  command->add_flag("--realtime", args->realtime,
                    "Play at the recorded pace; frames that come too late are dropped and counted");
  command->add_option("--max-frames", args->max_frames, "Stop after this many frames; 0 = all")
      ->capture_default_str();
  command->add_option("--start", args->start_s, "Skip this many seconds at the beginning")
      ->check(CLI::NonNegativeNumber)
      ->capture_default_str();
  command->add_flag("--no-loop", args->no_loop, "Without loop closing");
  command->add_flag("--no-merge", args->no_merge,
                    "Maps begun after tracking was lost are not joined to earlier ones");
  command
      ->add_option("--backend", args->backend, "How loops are closed; auto: the fastest there is")
      ->check(CLI::IsMember({"auto", "reference", "cpu", "cuda"}))
      ->capture_default_str();
  command->add_option("--save-map", args->save_map, "File that receives the map at the end");
  command->add_option("--load-map", args->load_map,
                      "Map of an earlier run with the same cameras; what is new joins it when the "
                      "place is recognised");
  command->add_flag("--localize", args->localize,
                    "Only find the way in the loaded map: nothing is added to it");
  command->add_option("--record-loops", args->record_loops,
                      "Folder that receives the map as it was just before each loop, for replay");
  command->add_flag("--quiet", args->quiet, "No progress lines");
  command->footer(
      "Example: fastloop run /data/MH_01_easy --out /tmp/mh01 && fastloop eval "
      "/data/MH_01_easy/mav0/state_groundtruth_estimate0/data.csv "
      "/tmp/mh01/trajectory_body.txt\nExit codes: 0 success, 2 bad input, 3 tracking never "
      "initialised.");
  command->callback([args, &exit_code] { exit_code = run(*args); });
}

}  // namespace fastloop::apps
