#include "fastloop/loop/similarity_ransac.hpp"

#include <algorithm>
#include <cmath>

namespace fastloop::loop {
namespace {

PairArrays arrays_of(const SimilarityPairs& p) {
  return {p.p_first.data(),    p.pixel_first.data(), p.gate_first.data(),
          p.p_second.data(),   p.view.data(),        p.pixel_view.data(),
          p.gate_view.data(),  p.views.data(),       static_cast<int>(p.size())};
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

void find_similarities(const Executor& executor, const matching::CameraView& camera,
                       std::span<const SimilarityPairs> problems, const RansacOptions& options,
                       std::span<RansacResult> results) {
  struct Search {
    PairArrays pairs;
    int total;
    std::vector<int> counts;
  };
  std::vector<Search> searches;
  for (std::size_t p = 0; p < problems.size(); ++p) {
    searches.push_back({arrays_of(problems[p]), hypotheses_for(problems[p].size(), options), {}});
    results[p] = RansacResult{};
  }
  // The chunks of all undecided problems side by side, until every problem is decided.
  for (int begin = 0;; begin += options.chunk) {
    std::vector<std::pair<std::size_t, int>> work;
    for (std::size_t p = 0; p < problems.size(); ++p) {
      const int end = std::min(begin + options.chunk, searches[p].total);
      if (results[p].found || begin >= end) continue;
      searches[p].counts.assign(static_cast<std::size_t>(end - begin), 0);
      for (int h = begin; h < end; ++h) work.emplace_back(p, h);
    }
    if (work.empty()) break;
    executor.for_ranges(work.size(), 4, [&](std::size_t b, std::size_t e) {
      for (; b < e; ++b) {
        const auto [p, h] = work[b];
        searches[p].counts[static_cast<std::size_t>(h - begin)] =
            count_inliers(camera, searches[p].pairs, options, h);
      }
    });
    for (std::size_t p = 0; p < problems.size(); ++p)
      if (!results[p].found && begin < searches[p].total)
        take_best(searches[p].counts, begin, options, results[p]);
  }
  for (std::size_t p = 0; p < problems.size(); ++p)
    complete(camera, searches[p].pairs, options, results[p]);
}

}  // namespace fastloop::loop
