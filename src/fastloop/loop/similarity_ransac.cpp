#include "fastloop/loop/similarity_ransac.hpp"

#include <algorithm>
#include <cmath>

#include "fastloop/loop/similarity_ransac_cuda.hpp"

namespace fastloop::loop {
namespace {

PairArrays arrays_of(const SimilarityPairs& p) {
  return {p.p_first.data(),
          p.pixel_first.data(),
          p.gate_first.data(),
          p.p_second.data(),
          p.view.data(),
          p.pixel_view.data(),
          p.gate_view.data(),
          p.views.data(),
          static_cast<int>(p.size()),
          static_cast<int>(p.views.size())};
}

/// Hypotheses needed to draw one sample without outliers when just enough pairs are inliers.
int hypotheses_for(std::size_t pairs, const RansacOptions& o) {
  if (pairs < 3 || static_cast<int>(pairs) <= o.min_inliers) return 0;
  const double share = static_cast<double>(o.min_inliers) / static_cast<double>(pairs);
  const double good = share * share * share;
  if (good >= 1) return 1;
  const double needed = std::ceil(std::log(1 - o.confidence) / std::log(1 - good));
  return static_cast<int>(std::clamp(needed, 1.0, static_cast<double>(o.max_hypotheses)));
}

int count_inliers(const matching::CameraView& camera, const PairArrays& pairs,
                  const RansacOptions& o, int hypothesis) {
  SimilarityF s;
  if (!make_hypothesis(pairs, o.seed, hypothesis, o.fixed_scale, &s)) return 0;
  int count = 0;
  for (int i = 0; i < pairs.size; ++i) count += is_inlier(camera, pairs, s, i);
  return count;
}

/// Looks at the counts of one chunk; true when it decides.
bool take_best(std::span<const int> counts, int begin, const RansacOptions& o,
               RansacResult& result) {
  for (std::size_t i = 0; i < counts.size(); ++i)
    if (counts[i] > result.num_inliers) {
      result.num_inliers = counts[i];
      result.hypothesis = begin + static_cast<int>(i);
    }
  result.evaluated = begin + static_cast<int>(counts.size());
  return result.found = result.num_inliers > o.min_inliers;
}

void complete(const matching::CameraView& camera, const PairArrays& pairs, const RansacOptions& o,
              RansacResult& result) {
  if (!result.found) {
    result.hypothesis = -1;
    return;
  }
  SimilarityF s;
  make_hypothesis(pairs, o.seed, result.hypothesis, o.fixed_scale, &s);
  result.inlier.resize(static_cast<std::size_t>(pairs.size));
  for (int i = 0; i < pairs.size; ++i)
    result.inlier[static_cast<std::size_t>(i)] = is_inlier(camera, pairs, s, i);
  Matrix3d r;
  for (int k = 0; k < 9; ++k) r(k / 3, k % 3) = static_cast<double>(s.rotation[k]);
  result.S_first_second =
      Sim3(Eigen::Quaterniond(r), Eigen::Map<Eigen::Vector3f>(s.translation).cast<double>(),
           static_cast<double>(s.scale));
}

}  // namespace

namespace {

/// A problem on its way to a decision.
struct Search {
  PairArrays pairs;
  int total;  ///< hypotheses that it may take
  std::vector<int> counts;
};

/// Evaluates [begin, begin + chunk) of all undecided problems side by side and looks at the counts.
void try_chunk(const Executor& executor, const matching::CameraView& camera,
               const RansacOptions& options, int begin, std::span<Search> searches,
               std::span<RansacResult> results) {
  std::vector<std::pair<std::size_t, int>> work;
  for (std::size_t p = 0; p < searches.size(); ++p) {
    searches[p].counts.clear();
    if (results[p].found) continue;
    const int end = std::min(begin + options.chunk, searches[p].total);
    for (int h = begin; h < end; ++h) work.emplace_back(p, h);
    searches[p].counts.assign(static_cast<std::size_t>(std::max(0, end - begin)), 0);
  }
  executor.for_ranges(work.size(), 4, [&](std::size_t b, std::size_t e) {
    for (; b < e; ++b) {
      const auto [p, h] = work[b];
      searches[p].counts[static_cast<std::size_t>(h - begin)] =
          count_inliers(camera, searches[p].pairs, options, h);
    }
  });
  for (std::size_t p = 0; p < searches.size(); ++p)
    if (!searches[p].counts.empty()) take_best(searches[p].counts, begin, options, results[p]);
}

/// Evaluates all hypotheses from `begin` on in one go on the device, then looks at them chunk by
/// chunk as if they had come so. False when the device failed; nothing is decided then.
bool try_rest(const Executor& executor, const matching::CameraView& camera,
              const RansacOptions& options, int begin, std::span<const Search> searches,
              std::span<RansacResult> results) {
  std::vector<HypothesisRange> ranges;
  std::vector<std::size_t> problem;
  for (std::size_t p = 0; p < searches.size(); ++p) {
    if (results[p].found || searches[p].total <= begin) continue;
    ranges.push_back({searches[p].pairs, begin, searches[p].total, {}});
    problem.push_back(p);
  }
  if (!count_inliers_cuda(*executor.cuda_session(), camera, options.seed, options.fixed_scale,
                          ranges))
    return false;
  for (std::size_t r = 0; r < ranges.size(); ++r) {
    const std::span<const int> counts = ranges[r].counts;
    for (std::size_t at = 0; at < counts.size(); at += static_cast<std::size_t>(options.chunk)) {
      const std::size_t n = std::min(counts.size() - at, static_cast<std::size_t>(options.chunk));
      if (take_best(counts.subspan(at, n), begin + static_cast<int>(at), options,
                    results[problem[r]]))
        break;
    }
  }
  return true;
}

/// Hypotheses of undecided problems in [begin, end), each as often as its problem has pairs.
double work_left(std::span<const Search> searches, std::span<const RansacResult> results, int begin,
                 int end) {
  double work = 0;
  for (std::size_t p = 0; p < searches.size(); ++p)
    if (!results[p].found)
      work += static_cast<double>(searches[p].pairs.size) *
              std::max(0, std::min(end, searches[p].total) - begin);
  return work;
}

}  // namespace

void find_similarities(const StepExecutors& executors, const matching::CameraView& camera,
                       std::span<const SimilarityPairs> problems, const RansacOptions& options,
                       std::span<RansacResult> results) {
  std::vector<Search> searches;
  int most = 0;
  for (std::size_t p = 0; p < problems.size(); ++p) {
    searches.push_back({arrays_of(problems[p]), hypotheses_for(problems[p].size(), options), {}});
    results[p] = RansacResult{};
    most = std::max(most, searches[p].total);
  }
  bool device_failed = false;
  for (int begin = 0; begin < most; begin += options.chunk) {
    if (work_left(searches, results, begin, most) == 0) break;
    // Most problems that have a solution show it in the first chunk.
    const double work = work_left(searches, results, begin, begin == 0 ? options.chunk : most);
    const Executor& executor = executors.of(Step::kSimilarity, work);
    if (executor.kind() == Executor::Kind::kCuda && !device_failed) {
      if (try_rest(executor, camera, options, begin, searches, results)) break;
      device_failed = true;
    }
    try_chunk(executor, camera, options, begin, searches, results);
  }
  for (std::size_t p = 0; p < problems.size(); ++p)
    complete(camera, searches[p].pairs, options, results[p]);
}

}  // namespace fastloop::loop
