// Tracking of whole frames (System::process: images in memory to pose, mapping thread running), as a ratio to
// OpenCV's cv::ORB in the same run.
//
// Sequence: the folder named by FASTLOOP_BENCH_SEQUENCE (any layout that `fastloop run` reads), otherwise 20 s of
// the simulator's room. FASTLOOP_BENCH_FRAMES limits the number of frames; 0 or unset = all.
//
// Counters:
//   ratio       median time of a frame over the median time of cv::ORB::detectAndCompute (1,200 features, 8 levels,
//               one thread) on both images of a frame, one after the other; every fourth frame is measured
//   last_first  median time of a frame in the last fifth of the sequence over that in the first fifth, each in units
//               of cv::ORB's median in the same fifth: other programs on the machine come and go
//   features    medians of rectification, extraction and stereo matching over the median time of a frame
//   pose        the same of prediction, both searches and the pose
#include <benchmark/benchmark.h>

#include <algorithm>
#include <cstdlib>
#include <opencv2/core/utility.hpp>
#include <opencv2/features2d.hpp>
#include <string>

#include "fastloop/core/logging.hpp"
#include "fastloop/core/timing.hpp"
#include "fastloop/sim/sequence.hpp"
#include "fastloop/system/system.hpp"

namespace fastloop {
namespace {

constexpr std::size_t kMeasureOrbEvery = 4;

std::unique_ptr<io::Dataset> open_sequence() {
  if (const char* folder = std::getenv("FASTLOOP_BENCH_SEQUENCE")) return io::open_dataset(folder);
  sim::SequenceOptions options;
  options.seconds = 20;
  return std::make_unique<sim::SimulatedSequence>(options);
}

std::size_t frame_count(const io::Dataset& dataset) {
  const char* limit = std::getenv("FASTLOOP_BENCH_FRAMES");
  const std::size_t wanted = limit ? std::strtoul(limit, nullptr, 10) : 0;
  return wanted > 0 ? std::min(wanted, dataset.size()) : dataset.size();
}

/// Rendering uses every core: it is done before anything is measured. Files are decoded on the way.
std::vector<FrameInput> rendered_frames(const io::Dataset& dataset, std::size_t count) {
  std::vector<FrameInput> frames;
  if (dataset.format() != "simulated") return frames;
  for (std::size_t i = 0; i < count; ++i) frames.push_back(dataset.load(i));
  return frames;
}

double orb_ms(const FrameInput& frame, cv::Feature2D& orb) {
  std::vector<cv::KeyPoint> keypoints;
  cv::Mat descriptors;
  const Stopwatch watch;
  for (const ImageU8* image : {&frame.left, &frame.right}) {
    const cv::Mat view(image->height, image->width, CV_8UC1, const_cast<std::uint8_t*>(image->pixels.data()));
    orb.detectAndCompute(view, cv::noArray(), keypoints, descriptors);
  }
  return watch.elapsed_ms();
}

double median(const std::vector<double>& samples) { return summarize(samples).p50_ms; }

/// Median of one of five equal parts.
double median_of_fifth(const std::vector<double>& samples, std::size_t part) {
  const auto at = [&](std::size_t i) { return samples.begin() + static_cast<std::ptrdiff_t>(samples.size() * i / 5); };
  return median({at(part), at(part + 1)});
}

void track_sequence(benchmark::State& state) {
  const auto dataset = open_sequence();
  const std::size_t count = frame_count(*dataset);
  const std::vector<FrameInput> rendered = rendered_frames(*dataset, count);
  for (auto _ : state) {
    system::System system(dataset->calibration(), {});
    cv::setNumThreads(1);
    const auto orb = cv::ORB::create(1200, 1.2f, 8);
    std::vector<double> track, reference;
    std::size_t tracked = 0;
    for (std::size_t i = 0; i < count; ++i) {
      const FrameInput loaded = rendered.empty() ? dataset->load(i) : FrameInput{};
      const FrameInput& frame = rendered.empty() ? loaded : rendered[i];
      const auto& record = system.process(frame);
      track.push_back(record.tracking_ms);
      tracked += record.state == tracking::State::kTracking;
      if (i % kMeasureOrbEvery == 0) reference.push_back(orb_ms(frame, *orb));
    }
    system.finish();
    double features = 0;
    for (const char* stage : {"rectify", "orb", "stereo"})
      if (const auto samples = system.times().samples(stage); !samples.empty()) features += median(samples);
    double search = 0;
    for (const char* stage : {"predict", "last_frame", "local_map", "pose"})
      if (const auto samples = system.times().samples(stage); !samples.empty()) search += median(samples);
    state.SetIterationTime(median(track) / 1e3);
    state.counters["ratio"] = median(track) / median(reference);
    const auto cost = [&](std::size_t part) { return median_of_fifth(track, part) / median_of_fifth(reference, part); };
    state.counters["last_first"] = cost(4) / cost(0);
    state.counters["features"] = features / median(track);
    state.counters["pose"] = search / median(track);
    state.counters["tracked"] = static_cast<double>(tracked) / static_cast<double>(count);
    state.counters["keyframes"] = static_cast<double>(system.snapshot()->num_keyframes());
  }
}
BENCHMARK(track_sequence)->Iterations(1)->UseManualTime()->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace fastloop
