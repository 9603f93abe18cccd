// Feature extraction and whole frames, as ratios to OpenCV's cv::ORB in the same run.
//
// Images: a synthetic texture, or the pair named by FASTLOOP_BENCH_LEFT and FASTLOOP_BENCH_RIGHT
// (grey files of the EuRoC camera, 752 x 480).
//
// The counter "ratio" is the time of ours over that of cv::ORB::detectAndCompute (1,200 features, 8
// levels, one thread) on the same images one after the other, both measured alternately, medians.
#include <benchmark/benchmark.h>
#include <tbb/global_control.h>
#include <tbb/parallel_invoke.h>

#include <algorithm>
#include <cstdlib>
#include <opencv2/features2d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <stdexcept>

#include "fastloop/core/time.hpp"
#include "fastloop/features/cv_view.hpp"
#include "fastloop/features/frame_builder.hpp"
#include "fastloop/features/hamming.hpp"
#include "fastloop/features/scene_for_tests.hpp"

namespace fastloop {
namespace {

ImageU8 image_of(const char* variable, unsigned seed) {
  const char* path = std::getenv(variable);
  if (!path) return synthetic_scene::textured_image(752, 480, seed);
  const cv::Mat mat = cv::imread(path, cv::IMREAD_GRAYSCALE);
  if (mat.empty()) throw std::runtime_error(std::string(variable) + ": cannot read " + path);
  ImageU8 image(mat.cols, mat.rows);
  mat.copyTo(as_mat(image));
  return image;
}

FrameInput stereo_input() {
  FrameInput input;
  input.left = image_of("FASTLOOP_BENCH_LEFT", 1);
  if (std::getenv("FASTLOOP_BENCH_RIGHT")) {
    input.right = image_of("FASTLOOP_BENCH_RIGHT", 1);
    return input;
  }
  // The left image moved by a disparity of 12 pixels.
  input.right = input.left;
  for (int y = 0; y < input.right.height; ++y)
    std::copy(input.left.row(y) + 12, input.left.row(y) + input.left.width, input.right.row(y));
  return input;
}

/// EuRoC's pair: distorted, so that frames include rectification.
Calibration calibration(int width, int height) {
  Calibration c;
  const Camera camera{CameraModel::kPinhole,
                      width,
                      height,
                      458.654,
                      457.296,
                      367.215,
                      248.375,
                      {-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0}};
  c.cameras.push_back({camera, SE3(), 20});
  c.cameras.push_back({camera, SE3(Eigen::Quaterniond::Identity(), Vector3d(0.11, 0, 0)), 20});
  return c;
}

double median(std::vector<double> v) {
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

/// Runs `ours` in the timed loop and cv::ORB on both images between, untimed; adds the counters.
template <class Ours>
void compare_with_opencv(benchmark::State& state, const FrameInput& input, const Ours& ours) {
  cv::setNumThreads(1);
  const auto orb = cv::ORB::create(1200, 1.2f, 8);
  std::vector<cv::KeyPoint> keypoints;
  cv::Mat descriptors;
  std::vector<double> ours_ms, opencv_ms;
  for (auto _ : state) {
    Stopwatch watch;
    ours();
    ours_ms.push_back(watch.elapsed_ms());
    state.SetIterationTime(ours_ms.back() * 1e-3);
    watch.restart();
    for (const ImageU8* image : {&input.left, &input.right})
      orb->detectAndCompute(as_mat(*image), cv::noArray(), keypoints, descriptors);
    opencv_ms.push_back(watch.elapsed_ms());
  }
  state.counters["opencv_ms"] = median(opencv_ms);
  state.counters["ours_ms"] = median(ours_ms);
  state.counters["ratio"] = median(ours_ms) / median(opencv_ms);
}

/// Argument: threads; 0 is all.
void bench_extract_pair(benchmark::State& state) {
  const FrameInput input = stereo_input();
  OrbExtractor left, right;
  const auto threads = static_cast<std::size_t>(state.range(0));
  tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads ? threads : 1024);
  compare_with_opencv(state, input, [&] {
    tbb::parallel_invoke([&] { benchmark::DoNotOptimize(left.extract(input.left)); },
                         [&] { benchmark::DoNotOptimize(right.extract(input.right)); });
  });
}
BENCHMARK(bench_extract_pair)
    ->Arg(1)
    ->Arg(2)
    ->Arg(0)
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

void bench_build_frame(benchmark::State& state) {
  const FrameInput input = stereo_input();
  FrameBuilder builder(calibration(input.left.width, input.left.height), {});
  StageTimes times;
  const auto threads = static_cast<std::size_t>(state.range(0));
  tbb::global_control limit(tbb::global_control::max_allowed_parallelism, threads ? threads : 1024);
  compare_with_opencv(state, input,
                      [&] { benchmark::DoNotOptimize(builder.build(input, &times)); });
  for (const auto& [stage, s] : times.statistics()) state.counters[stage + "_ms"] = s.p50_ms;
}
BENCHMARK(bench_build_frame)
    ->Arg(1)
    ->Arg(2)
    ->Arg(0)
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

/// Argument: 1 with run-time dispatch, 0 portable. One query against 1,000 candidates.
void bench_hamming(benchmark::State& state) {
  std::mt19937_64 rng(1);
  std::vector<Descriptor> candidates(1000);
  std::vector<std::uint16_t> indices(candidates.size()), distances(candidates.size());
  for (std::size_t i = 0; i < candidates.size(); ++i) {
    for (auto& w : candidates[i].words) w = rng();
    indices[i] = static_cast<std::uint16_t>(i);
  }
  for (auto _ : state) {
    if (state.range(0))
      hamming_distances(candidates[7], candidates.data(), indices, distances.data());
    else
      reference::hamming_distances(candidates[7], candidates.data(), indices, distances.data());
    benchmark::DoNotOptimize(distances.data());
  }
  state.SetItemsProcessed(state.iterations() * static_cast<std::int64_t>(candidates.size()));
}
BENCHMARK(bench_hamming)->Arg(0)->Arg(1);

}  // namespace
}  // namespace fastloop
