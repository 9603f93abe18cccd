#include "calibration.hpp"

#include <algorithm>
#include <functional>
#include <random>

#include "fastloop/core/time.hpp"
#include "fastloop/loop/keyframe_search.hpp"
#include "fastloop/loop/similarity_ransac.hpp"
#include "fastloop/loop/verification.hpp"
#include "fastloop/map/essential_graph.hpp"
#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/sim/map_worlds.hpp"

namespace fastloop::apps {
namespace {

using loop::CostModel;
using loop::Step;
using loop::StepCost;

constexpr int kRepeats = 15;

double median_us(const std::function<void()>& call) {
  for (int i = 0; i < 3; ++i) call();
  std::vector<double> us;
  for (int i = 0; i < kRepeats; ++i) {
    const Stopwatch watch;
    call();
    us.push_back(1e3 * watch.elapsed_ms());
  }
  std::nth_element(us.begin(), us.begin() + kRepeats / 2, us.end());
  return us[kRepeats / 2];
}

/// One amount of work and how to do it.
struct Load {
  double work;
  std::function<void(const Executor&)> run;
};

StepCost line_through(const Load& little, const Load& much, const Executor& executor) {
  const double a = median_us([&] { little.run(executor); });
  const double b = median_us([&] { much.run(executor); });
  StepCost cost;
  cost.unit_ns = std::max(0.0, 1e3 * (b - a) / (much.work - little.work));
  cost.fixed_us = std::max(0.0, a - 1e-3 * cost.unit_ns * little.work);
  return cost;
}

/// Pairs that show nothing in common: every hypothesis is looked at.
loop::SimilarityPairs random_pairs(int n, std::mt19937& rng) {
  std::uniform_real_distribution<float> u(-1, 1);
  loop::SimilarityPairs p;
  p.views.emplace_back(loop::ViewPose{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}});
  for (int i = 0; i < n; ++i) {
    for (std::vector<float>* side : {&p.p_first, &p.p_second})
      side->insert(side->end(), {2 * u(rng), 2 * u(rng), 6 + 2 * u(rng)});
    for (std::vector<float>* pixel : {&p.pixel_first, &p.pixel_view})
      pixel->insert(pixel->end(), {300 + 300 * u(rng), 200 + 200 * u(rng)});
    p.gate_first.push_back(9.21f);
    p.gate_view.push_back(9.21f);
    p.view.push_back(0);
  }
  return p;
}

Load similarity_load(const sim::SimulatedMap& world, int candidates, int pairs) {
  std::mt19937 rng(1);
  std::vector<loop::SimilarityPairs> problems;
  for (int i = 0; i < candidates; ++i) problems.push_back(random_pairs(pairs, rng));
  const loop::RansacOptions options;
  std::vector<loop::RansacResult> results(problems.size());
  const matching::CameraView camera = matching::make_camera_view(world.map.rig().left);
  loop::find_similarities(Executor::cpu(), camera, problems, options, results);
  double work = 0;
  for (const auto& r : results) work += static_cast<double>(pairs) * r.evaluated;
  return {work, [=](const Executor& executor) mutable {
            loop::find_similarities(executor, camera, problems, options, results);
          }};
}

Load projection_load(const map::Snapshot& snapshot, KeyframeId matched, std::size_t keyframes,
                     std::size_t window) {
  auto cloud = std::make_shared<map::LandmarkArrays>(
      snapshot, map::landmarks_of(snapshot, loop::window_of(snapshot, matched, window)));
  std::vector<loop::MovedKeyframe> moved;
  for (const KeyframeId id : loop::window_of(snapshot, matched, keyframes - 1))
    moved.push_back({id, snapshot.T_world_camera(id).inverse()});
  return {static_cast<double>(cloud->size() * moved.size()), [=, &snapshot](const Executor& e) {
            const loop::PlaceSearch place{cloud.get(), moved, nullptr};
            loop::find_in_keyframes(e, snapshot, {&place, 1}, 4, 50);
          }};
}

Load descriptor_load(const map::Snapshot& snapshot, std::span<const KeyframeId> ids,
                     std::span<const place::PlaceDatabase::Words> words) {
  std::vector<matching::MatchSide> sides;
  for (std::size_t i = 0; i < ids.size(); ++i)
    sides.push_back({snapshot.keyframe(ids[i]).data->features.get(), &words[i]->groups, {}});
  const double work = static_cast<double>(sides.front().features->size() * sides.size());
  return {work, [=](const Executor& executor) {
            matching::match_descriptors(executor, sides.front(), sides);
          }};
}

Load pose_graph_load(int keyframes) {
  sim::MapWorldOptions options;
  options.keyframes = keyframes;
  options.features = 300;
  const sim::SimulatedMap world = sim::simulate_map(options);
  const auto snapshot = world.map.publish();
  const KeyframeId matched = world.expected_matches.front();
  map::ClosedLoop closed{{matched, world.current, world.T_matched_current}, {}, {}, matched};
  closed.corrected.push_back(
      {world.current, world.map.T_world_body(matched) * world.T_matched_current});
  map::EssentialGraphOptions graph_options;
  graph_options.kind = optimization::PoseGraphKind::kSim3;
  graph_options.min_shared = 30;  // of the 300 features
  auto graph = std::make_shared<map::EssentialGraph>();
  map::build_essential_graph(*snapshot, snapshot->keyframe(matched).map, closed, graph_options,
                             *graph);
  return {6.0 * static_cast<double>(graph->problem.poses.size()), [graph](const Executor& e) {
            optimization::PoseGraphProblem problem = graph->problem;
            optimization::PoseGraphOptions solve;
            solve.relative_tolerance = 1e-14;  // as in loop closing
            solve.solver = e.cuda_session() ? optimization::PoseGraphSolverKind::kCuda
                                            : optimization::PoseGraphSolverKind::kBlock;
            optimization::solve_pose_graph(problem, solve);
          }};
}

CostModel::Costs costs_of(const Load& little, const Load& much, const Executor& cpu,
                          const Executor& device) {
  return {line_through(little, much, cpu), line_through(little, much, device)};
}

}  // namespace

CostModel measure_costs(const Executor& cpu, const Executor& device) {
  sim::MapWorldOptions options;
  options.keyframes = 300;
  const sim::SimulatedMap world = sim::simulate_map(options);
  const auto snapshot = world.map.publish();
  const KeyframeId matched = world.expected_matches.front();
  CostModel model;
  model.of(Step::kSimilarity) =
      costs_of(similarity_load(world, 1, 20), similarity_load(world, 6, 200), cpu, device);
  const std::vector<KeyframeId> ids = loop::window_of(*snapshot, matched, 29);
  for (const KeyframeId id : ids)
    matching::make_resident(device, snapshot->keyframe(id).data->features);
  model.of(Step::kProjection) = costs_of(projection_load(*snapshot, matched, 1, 0),
                                         projection_load(*snapshot, matched, 20, 20), cpu, device);
  const place::PlaceDatabase database(place::default_vocabulary());
  std::vector<place::PlaceDatabase::Words> words;
  for (const KeyframeId id : ids)
    words.push_back(database.words_of(snapshot->keyframe(id).data->features->descriptors));
  model.of(Step::kDescriptors) =
      costs_of(descriptor_load(*snapshot, std::span(ids).first(2), words),
               descriptor_load(*snapshot, ids, words), cpu, device);
  model.of(Step::kPoseGraph) = costs_of(pose_graph_load(300), pose_graph_load(3000), cpu, device);
  return model;
}

}  // namespace fastloop::apps
